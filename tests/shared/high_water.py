"""The peak memory of a part of a process, on Linux."""

from pathlib import Path

from vggtjax.storage.memory import process_bytes

_RESET = "5"  # of clear_refs


def reset_high_water() -> int | None:
    """Set VmHWM to the present memory of the process and return it; None where this is impossible."""
    try:
        Path("/proc/self/clear_refs").write_text(_RESET)
    except OSError:
        return None
    return process_bytes("VmRSS")
