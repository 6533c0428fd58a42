"""What memory this process holds, as Linux tells it; elsewhere nothing is known."""

from __future__ import annotations

from pathlib import Path

_PROCESS = Path("/proc/self")
_RESET_HIGH_WATER = "5"  # of clear_refs


def process_bytes(name: str) -> int | None:
    """Return a figure of /proc/self/status, such as VmRSS, VmHWM or RssAnon, in bytes; None where there is none."""
    try:
        lines = dict(line.split(":", 1) for line in (_PROCESS / "status").read_text().splitlines())
        return int(lines[name].split()[0]) * 1024
    except (OSError, LookupError):
        return None


def reset_high_water() -> int | None:
    """Set VmHWM to what the process holds now, and return that; None where that cannot be done."""
    try:
        (_PROCESS / "clear_refs").write_text(_RESET_HIGH_WATER)
    except OSError:
        return None
    return process_bytes("VmRSS")
