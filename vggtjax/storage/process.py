"""Settings of this process: its cores, what its allocator keeps, threads of devices, limits that are too low.

Does not import jax before it is needed.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from contextlib import suppress
from functools import cache

from vggtjax.errors import InputError
from vggtjax.storage.memory import in_gigabytes, own_limits

_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8  # names of glibc's malloc.h
_MOST = 2**31 - 1  # of its settings
_LIBRARIES, _OF_A_CORE = 1_000_000_000, 20_000_000  # bytes of address space; a core's threads have stacks


@cache
def core_count() -> int:
    """Return the number of cores, at least 1: those that `taskset` or a batch system left to the process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def return_freed_memory() -> None:
    """Return to the system what the process has freed and the C library keeps, of each thread; glibc alone does so.

    A compiler frees hundreds of megabytes that no other thread would use again.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # musl has no malloc_trim
            ctypes.CDLL(None).malloc_trim(0)


def keep_freed_memory(*, training: bool = False) -> bool:
    """Tell glibc to keep freed memory in the process; return whether it listened (False on other systems).

    XLA takes the working memory of every call anew. By default glibc maps blocks of that size from the kernel and gives
    them back at once, and the kernel then spends longer on clearing their pages than the processor on the network:
    of a training step of the small model on two cores, 94 % of the time was the kernel's.

    One arena holds the memory of all threads, so that nothing is kept twice; its lock and its long lists of free blocks
    take a quarter of a training step. With `training`, threads have arenas of their own: see `run_in_calling_thread`.

    A setting of the whole process: commands call it, a program's own process is left alone.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = [(_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, _MOST), *(() if training else ((_M_ARENA_MAX, 1),))]
    taken = [mallopt(name, value) == 1 for name, value in settings]  # every one is tried
    return all(taken)


def run_in_calling_thread() -> None:
    """Have the calling thread run programs on a CPU, where jax would hand them to another; call it before jax computes.

    Of several arenas only the first, that of the main thread, keeps large blocks when they are freed.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def give_devices_threads() -> None:
    """Have XLA start two threads for each device of a split CPU, unless PJRT_NPROC says how many.

    XLA_FLAGS or JAX_NUM_CPU_DEVICES splits it. By default there are as many threads as devices, if these are more than
    the cores. Devices that wait for each other then hold all threads, nobody computes what they wait for, and XLA ends
    the process after 40 seconds.

    Call it before jax starts: XLA reads the variable once.
    """
    counts = re.findall(r"--xla_force_host_platform_device_count=(\d{1,4})\b", os.environ.get("XLA_FLAGS", ""))
    counts += re.findall(r"^\d{1,4}$", os.environ.get("JAX_NUM_CPU_DEVICES", ""))
    if counts and int(counts[-1]) > 1:
        os.environ.setdefault("PJRT_NPROC", str(max(2 * int(counts[-1]), os.cpu_count() or 1)))


def check_limits() -> None:
    """Raise InputError where a limit of this process (`ulimit -v`) does not even leave room for loading the libraries.

    A library that cannot start a thread or map a file ends the process without a sentence.
    """
    needed = _LIBRARIES + _OF_A_CORE * (os.cpu_count() or 1)
    for name, limit, used in own_limits():
        if limit - used < needed:
            raise InputError(
                f"{name} leaves this process {in_gigabytes(limit - used)}, and its libraries take "
                f"{in_gigabytes(needed)}; set a higher limit, or none: {name} unlimited"
            )
