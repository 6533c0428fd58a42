"""Memory that a process keeps."""

import subprocess
import sys

import pytest

COUNT = """
import ctypes
import resource
import statistics
ctypes.CDLL(None).prctl(41, 1, 0, 0, 0)  # no huge pages (PR_SET_THP_DISABLE): a fault counts 4 KiB
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
x = jax.numpy.arange(3100.0)  # 37 MiB: glibc keeps blocks of less than 32 MiB by itself
step = jax.jit(lambda x: jax.lax.sort(x[None] + x[:, None], dimension=0).sum())
def work():
    step(x).block_until_ready()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a setting of glibc")
@pytest.mark.parametrize("code", [ARRAYS, pytest.param(TRAINING, marks=pytest.mark.proof)], ids=["arrays", "training"])
def test_memory_that_was_freed_is_used_again(code):
    """In a process of its own hardly a page is faulted in most turns; without the settings, thousands in every turn.

    A few turns have to find places for their blocks first: the median counts.
    """
    assert faults_of(code) < 2000
    assert faults_of("\n".join(line for line in code.splitlines() if "assert" not in line)) > 5000


def faults_of(code):
    made = subprocess.run([sys.executable, "-c", code + COUNT], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return int(made.stdout)
