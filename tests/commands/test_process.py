"""The settings of its process that a command makes."""

import os
import subprocess
import sys

import pytest

COUNT = """
import resource
for turn in range(8):  # the first ones find places for all blocks
    work()
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    if turn == 5:
        first = faults
print(faults - first)
"""
ARRAYS = """
import numpy as np
from vggtjax.commands.process import keep_freed_memory
assert keep_freed_memory()
def work():
    np.ones(1 << 24)  # 128 MiB
"""
TRAINING = """
import jax
from vggtjax.commands.process import keep_freed_memory, run_in_calling_thread
assert keep_freed_memory(training=True)
run_in_calling_thread()
x = jax.numpy.arange(5800.0)
step = jax.jit(lambda x: jax.lax.sort(x[None] + x[:, None], dimension=0).sum())  # 128 MiB of working memory
def work():
    step(x).block_until_ready()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a setting of glibc")
@pytest.mark.parametrize(("code", "most"), [(ARRAYS, 200), (TRAINING, 2000)], ids=["arrays", "training"])
def test_memory_that_was_freed_is_used_again(code, most):
    """In a process of its own: touching memory that the process has kept faults no page."""
    made = subprocess.run([sys.executable, "-c", code + COUNT], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert int(made.stdout) < most


def test_devices_of_a_split_cpu_have_threads_to_wait_and_to_compute(monkeypatch):
    from vggtjax.commands.process import give_devices_threads

    flag = "--xla_force_host_platform_device_count"
    many = str(max(198, os.cpu_count() or 1))
    for flags, count, given, threads in (
        (f"--a=1 {flag}=99", "-1", None, many),
        (f"{flag}=99", "", "3", "3"),
        (f"{flag}=1", "", None, None),
        ("", "99", None, many),
        ("", "-1", None, None),
    ):
        with monkeypatch.context() as patch:
            patch.setenv("XLA_FLAGS", flags)
            patch.setenv("JAX_NUM_CPU_DEVICES", count)
            patch.delenv("PJRT_NPROC", raising=False)
            if given:
                patch.setenv("PJRT_NPROC", given)
            give_devices_threads()
            assert os.environ.get("PJRT_NPROC") == threads
            os.environ.pop("PJRT_NPROC", None)


def test_other_systems_are_left_alone(monkeypatch):
    from vggtjax.commands.process import keep_freed_memory

    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()
