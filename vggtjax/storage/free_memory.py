"""How much memory a process may still take: of the host, of its control groups, and of its own limits. Linux only."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_KILO = 1024
_NO_LIMIT = 1 << 60  # larger limits of version 1 stand for none
_V1 = ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file")
_V2 = ("memory.max", "memory.current", "inactive_file")
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
    return _kilobytes(root / "proc/meminfo", "MemTotal")


def rooms(root: Path = Path("/")) -> list[Room]:
    """Return how large this process can get by each of the limits that there are."""
    held = _kilobytes(root / "proc/self/status", "VmRSS") or 0
    return [room._replace(size=held + room.size) for room in _left(root)]


def free_bytes(root: Path = Path("/")) -> float | None:
    """Return what is free for this process beside what it holds; None where the system does not tell."""
    return min((room.size for room in _left(root)), default=None)


def _left(root: Path) -> list[Room]:
    """Return what each of the limits leaves beside what this process holds."""
    available = _kilobytes(root / "proc/meminfo", "MemAvailable")
    if available is None:
        return []
    left = [Room(available, "of the computer")]
    left += [Room(size, "of its container (cgroup)", True) for size in _group_rooms(root)]
    left += [Room(max(0, limit - used - _LATER), f"within {name}", True) for name, limit, used in own_limits(root)]
    return left


def own_limits(root: Path = Path("/")) -> list[tuple[str, int, int]]:
    """Return name, limit and present use of each limit that is set for this process, such as by `ulimit -v`."""
    try:
        lines = (root / "proc/self/limits").read_text().splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        for title, (figure, name) in _LIMITS.items():
            soft = line.removeprefix(title).split()[0] if line.startswith(title) else "unlimited"
            used = _kilobytes(root / "proc/self/status", figure)
            if soft.isdecimal() and used is not None:
                found.append((name, int(soft), used))
    return found


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


def return_freed_memory() -> None:
    """Return to the system what the process has freed and the C library keeps, of each thread; glibc alone does so.

    A compiler frees hundreds of megabytes that no other thread would use again.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # musl has no malloc_trim
            ctypes.CDLL(None).malloc_trim(0)
