"""Memory that is free by all limits of the computer, its control groups and the process (Linux only), or held."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_KILO = 1024
_NO_LIMIT = 1 << 60  # larger limits of version 1 stand for none
_V1 = ("sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_V2 = ("sys/fs/cgroup", "memory.max", "memory.current", "inactive_file")
_LATER = 300_000_000  # bytes of address space of threads that start later, without memory of their own
_LIMITS = {"Max address space": ("VmSize", "ulimit -v"), "Max data size": ("VmData", "ulimit -d")}


def in_gigabytes(size: float) -> str:
    """Return bytes as words: 0.66 GB, 12.3 GB."""
    giga = size / 1e9
    return f"{giga:.2f} GB" if giga < 10 else f"{giga:.1f} GB"


class Room(NamedTuple):
    """How large a process can get, in bytes, and what sets the limit, in words."""

    size: float
    limit: str
    is_hard: bool = False  # a process that gets larger is ended, or gets no memory: no other process can make room


def host_room(root: Path = Path("/")) -> Room | None:
    """Return how large this process can get: what it holds, and what is free; None where the system does not tell.

    The least of the computer's free memory, of what is left to its control groups, and of what its own limits leave.
    Pages of files that the kernel can drop count as free. `root` is for tests.
    """
    return min(rooms(root), default=None)


def total_bytes(root: Path = Path("/")) -> int | None:
    """Return the memory of the computer; None where the system does not tell."""
    return proc_bytes(root / "proc/meminfo", "MemTotal")


def rooms(root: Path = Path("/")) -> list[Room]:
    """Return how large this process can get by each of the limits that there are."""
    held = proc_bytes(root / "proc/self/status", "VmRSS") or 0
    return [room._replace(size=held + room.size) for room in _left(root)]


def free_bytes(root: Path = Path("/")) -> float | None:
    """Return what is free for this process beside what it holds; None where the system does not tell."""
    return min((room.size for room in _left(root)), default=None)


def _left(root: Path) -> list[Room]:
    """Return what each of the limits leaves beside what this process holds."""
    available = proc_bytes(root / "proc/meminfo", "MemAvailable")
    if available is None:
        return []
    left = [Room(available, "in the computer")]
    left += [Room(size, "in its container (cgroup)", True) for size in _group_rooms(root)]
    left += [Room(max(0, limit - used - _LATER), f"within {name}", True) for name, limit, used in own_limits(root)]
    return left


def own_limits(root: Path = Path("/")) -> list[tuple[str, int, int]]:
    """Return name, limit and present use of each limit that is set for this process, such as by `ulimit -v`."""
    found = []
    for line in _lines(root / "proc/self/limits"):
        for title, (figure, name) in _LIMITS.items():
            soft = line.removeprefix(title).split()[0] if line.startswith(title) else "unlimited"
            used = proc_bytes(root / "proc/self/status", figure)
            if soft.isdecimal() and used is not None:
                found.append((name, int(soft), used))
    return found


def _group_rooms(root: Path) -> Iterator[int]:
    """Yield what is left to each control group of this process that has a limit."""
    for line in _lines(root / "proc/self/cgroup"):
        number, controllers, place = line.split(":", 2)
        if number != "0" and "memory" not in controllers.split(","):
            continue
        groups, limit_name, used_name, droppable_name = _V2 if number == "0" else _V1
        group = Path(place.lstrip("/"))
        for part in (group, *group.parents):
            folder = root / groups / part
            limit, used = _number(folder / limit_name), _number(folder / used_name)
            if limit is None or used is None or limit >= _NO_LIMIT:
                continue
            yield max(0, limit - used + _droppable(folder / "memory.stat", droppable_name))


def _number(path: Path) -> int | None:
    text = "".join(_lines(path)).strip()
    return int(text) if text.isdecimal() else None  # "max": no limit


def _droppable(path: Path, name: str) -> int:
    try:
        return int(dict(line.split() for line in _lines(path)).get(name, 0))
    except ValueError:
        return 0


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


def proc_bytes(path: Path, name: str) -> int | None:
    """Return a figure in kB of a file of /proc, in bytes; None where there is none."""
    try:
        lines = dict(line.split(":", 1) for line in _lines(path) if ":" in line)
        return int(lines[name].split()[0]) * _KILO
    except (LookupError, ValueError):
        return None


def _lines(path: Path) -> list[str]:
    """Return the lines of a file of the system; none where it cannot be read."""
    try:
        return path.read_text().splitlines()
    except OSError:
        return []
