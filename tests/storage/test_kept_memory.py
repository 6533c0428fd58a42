"""Memory that a process keeps."""

import subprocess
import sys

import pytest

from vggtjax.storage.kept_memory import keep_freed_memory

COUNT = """
import resource
import statistics
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
turns = []
for _ in range(7):
    before = faults()
    work()
    turns.append(faults() - before)
print(int(statistics.median(turns)))
"""
ARRAYS = """
import numpy as np
from vggtjax.storage.kept_memory import keep_freed_memory
assert keep_freed_memory()
def work():
    np.ones(1 << 24)  # 128 MiB
"""
TRAINING = """
import jax
from vggtjax.storage.kept_memory import keep_freed_memory, run_in_calling_thread
assert keep_freed_memory(training=True)
run_in_calling_thread()
x = jax.numpy.arange(3100.0)
step = jax.jit(lambda x: jax.lax.sort(x[None] + x[:, None], dimension=0).sum())  # 37 MiB of working memory
def work():
    step(x).block_until_ready()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a setting of glibc")
@pytest.mark.parametrize(("code", "most"), [(ARRAYS, 200), (TRAINING, 2000)], ids=["arrays", "training"])
def test_memory_that_was_freed_is_used_again(code, most):
    """In a process of its own: most turns fault no page. Without the settings every turn does.

    A few turns have to find places for their blocks first: the median counts.
    """
    made = subprocess.run([sys.executable, "-c", code + COUNT], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert int(made.stdout) < most


def test_other_systems_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()
