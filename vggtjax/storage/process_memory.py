"""Memory of this process, such as its peak. Does not import jax."""

from __future__ import annotations

import sys
from pathlib import Path

from vggtjax.storage.free_memory import proc_bytes


def process_bytes(name: str) -> int | None:
    """Return a figure of /proc/self/status, such as VmRSS, VmHWM or RssAnon, in bytes; None if not on Linux."""
    return proc_bytes(Path("/proc/self/status"), name)


def peak_bytes() -> int | None:
    """Return the most memory that this process has held since its start, mapped files included; None if unknown."""
    if (peak := process_bytes("VmHWM")) is not None:  # unlike ru_maxrss, without the memory of the parent process
        return peak
    if sys.platform == "win32":
        return None
    import resource

    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
