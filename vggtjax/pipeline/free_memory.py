"""How much memory a process may still take: of the host, within the limits of its control groups. Linux only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

_KILO = 1024
_NO_LIMIT = 1 << 60  # larger limits of version 1 stand for none
_V1 = ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file")
_V2 = ("memory.max", "memory.current", "inactive_file")


def host_bytes(root: Path = Path("/")) -> int | None:
    """Return how large this process can get: what it holds, and what is free; None where the system does not tell.

    Pages of files that the kernel can drop count as free. `root` is for tests.
    """
    available = _kilobytes(root / "proc/meminfo", "MemAvailable")
    if available is None:
        return None
    held = _kilobytes(root / "proc/self/status", "VmRSS") or 0
    return held + min([available, *_group_rooms(root)])


def _group_rooms(root: Path) -> Iterator[int]:
    """Yield what is left to each control group of this process that has a limit."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, controllers, place = line.split(":", 2)
        if number != "0" and "memory" not in controllers.split(","):
            continue
        limit_name, used_name, droppable_name = _V2 if number == "0" else _V1
        group = Path(place.lstrip("/"))
        for part in (group, *group.parents):
            base = root / "sys/fs/cgroup"
            limit_file, used_file = (base / _inside(name, part) for name in (limit_name, used_name))
            limit, used = _number(limit_file), _number(used_file)
            if limit is None or used is None or limit >= _NO_LIMIT:
                continue
            yield max(0, limit - used + _droppable(used_file.with_name("memory.stat"), droppable_name))


def _inside(name: str, group: Path) -> Path:
    """Return where a file of a group lies below the folder of all groups: memory/GROUP/FILE or GROUP/FILE."""
    *controller, file = Path(name).parts
    return Path(*controller, group, file)


def _number(path: Path) -> int | None:
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None  # "max": no limit


def _droppable(path: Path, name: str) -> int:
    try:
        lines = dict(line.split() for line in path.read_text().splitlines())
        return int(lines.get(name, 0))
    except (OSError, ValueError):
        return 0


def _kilobytes(path: Path, name: str) -> int | None:
    """Return a figure in kB of a file of /proc, in bytes."""
    try:
        lines = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
        return int(lines[name].split()[0]) * _KILO
    except (OSError, LookupError, ValueError):
        return None
