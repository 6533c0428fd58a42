"""The setting of the C library that commands make."""

import subprocess
import sys

import pytest

CODE = """
import resource
import numpy as np
from vggtjax.commands.process import keep_freed_memory
assert keep_freed_memory()
for turn in range(4):
    np.ones(1 << 24)  # 128 MiB
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    if turn == 1:
        first = faults
print(faults - first)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a setting of glibc")
def test_memory_that_was_freed_is_used_again():
    """In a process of its own: touching memory that the process has kept faults no page."""
    made = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert int(made.stdout) < 200


def test_other_systems_are_left_alone(monkeypatch):
    from vggtjax.commands.process import keep_freed_memory

    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()
