"""Memory of this process on Linux; unknown on other systems."""

from __future__ import annotations

from pathlib import Path

_PROCESS = Path("/proc/self")
_RESET_HIGH_WATER = "5"  # of clear_refs


def process_bytes(name: str) -> int | None:
    """Return a figure of /proc/self/status, such as VmRSS, VmHWM or RssAnon, in bytes; None if unknown."""
    try:
        lines = dict(line.split(":", 1) for line in (_PROCESS / "status").read_text().splitlines())
        return int(lines[name].split()[0]) * 1024
    except (OSError, LookupError):
        return None


def reset_high_water() -> int | None:
    """Set VmHWM to the present memory of the process and return it; None where this is impossible."""
    try:
        (_PROCESS / "clear_refs").write_text(_RESET_HIGH_WATER)
    except OSError:
        return None
    return process_bytes("VmRSS")
