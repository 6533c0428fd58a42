"""The processor cores that this process may use. Does not import jax."""

from __future__ import annotations

import os
from functools import cache


@cache
def core_count() -> int:
    """Return the number of cores, at least 1: those that `taskset` or a batch system left to the process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
