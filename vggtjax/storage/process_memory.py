"""Memory of this process, such as its peak. Does not import jax."""

from __future__ import annotations

import sys
from pathlib import Path

from vggtjax.storage.free_memory import proc_bytes

_PROCESS = Path("/proc/self")
_RESET_HIGH_WATER = "5"  # of clear_refs


def process_bytes(name: str) -> int | None:
    """Return a figure of /proc/self/status, such as VmRSS, VmHWM or RssAnon, in bytes; None if not on Linux."""
    return proc_bytes(_PROCESS / "status", name)


def reset_high_water() -> int | None:
    """Set VmHWM to the present memory of the process and return it; None where this is impossible."""
    try:
        (_PROCESS / "clear_refs").write_text(_RESET_HIGH_WATER)
    except OSError:
        return None
    return process_bytes("VmRSS")


def peak_bytes() -> int | None:
    """Return the most memory that this process has held since its start, mapped files included; None if unknown."""
    if (peak := process_bytes("VmHWM")) is not None:  # unlike ru_maxrss, without the memory of the parent process
        return peak
    if sys.platform == "win32":
        return None
    import resource

    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
