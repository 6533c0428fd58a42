"""Settings of a process for much working memory: what is freed is kept. Does not import jax before it is needed."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8  # names of glibc's malloc.h
_MOST = 2**31 - 1


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
