"""Keeping the memory that one computation frees for the next one, on Linux."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8  # names of glibc's malloc.h
_MOST = 2**31 - 1


def keep_freed_memory() -> bool:
    """Tell glibc to keep freed memory in the process; return whether it listened (False on other systems).

    XLA takes the working memory of every call anew. By default glibc maps blocks of that size from the kernel and gives
    them back at once, and the kernel then spends longer on clearing their pages than the processor on the network:
    of a training step of the small model on two cores, 94 % of the time was the kernel's.

    A setting of the whole process: commands call it, the library never does.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, _MOST), (_M_ARENA_MAX, 1))
    taken = [mallopt(name, value) == 1 for name, value in settings]  # every one is tried
    return all(taken)
