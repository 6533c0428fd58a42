"""Times of frames that files state: in their names, or in lists beside them. Does not import jax."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal, InvalidOperation
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from vggtjax.errors import InputError, one_line, reading

logger = logging.getLogger(__name__)

# Names of lists of times, in any case of letters.
LISTS = ("timestamps.txt", "timestamp.txt", "times.txt", "timestamps.csv", "timestamp.csv", "times.csv", "data.csv")
_UNITS = {"seconds": 0, "milliseconds": 3, "microseconds": 6, "nanoseconds": 9}  # digits after the point of a second
_SHORT = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_STATED = re.compile(r"[\[(](s|ms|us|ns)[\])]")  # a unit, as in "#timestamp [ns]"
_HEADINGS = ("stamp", "time", _STATED, r"^(?:t|seconds|date)$")  # of columns of times, the surest first
_BEFORE_UNIT = re.compile(r"\s+(?=[\[(])")  # blanks
_TWO_PARTS = re.compile(r"(?<![\d.])(\d{10})[_-](\d{9})(?![\d.])")  # seconds and nanoseconds, as ROS has them
_CUT_PARTS = re.compile(r"(?<![\d.])\d{10}[_-](?:\d{3}|\d{6,})(?!\d)")  # seconds and a part that is not certain
_SINCE_1970 = re.compile(r"(?<![\d.])(?:\d{19}|\d{16}|\d{13}|\d{10}(?:\.\d{1,9})?|\d{9}\.\d{1,9})(?![\d.])")
_DATE = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])")  # 20240102..., which is no count
_SECONDS = re.compile(r"\d{1,18}\.\d{1,18}")  # a whole name
_NUMBER = re.compile(r"[+-]?\d{1,25}(?:\.\d{0,25})?(?:[eE][+-]?\d{1,2})?")
_FIRST, _LAST = Decimal(631_152_000), Decimal(4_102_444_800)  # the years 1990 to 2100
_LONGEST = Decimal(3600)  # seconds from frame to frame, in the middle, of names that are times
_FILMED = Decimal(2)  # the same of whole numbers in a list, or of a film's steady gaps, which may be in any unit
_APART = 5 * _FILMED  # the same of numbers with decimals whose gaps differ, as of keyframes
_STEADY = Decimal("1.2")  # of a film: times between a fourth and three fourths of the gaps
_MOMENT = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?(Z|[+-]\d\d:?\d\d)?")
_MOST_DIGITS = 9
_MOST_BYTES = 2**26
_LONGEST_LINE = 2**12


@dataclass(frozen=True)
class FrameTimes:
    """Times of frames in seconds, exactly as the source states them, and where they are from."""

    seconds: tuple[Decimal, ...]
    origin: str

    @property
    def first(self) -> Decimal:
        """The time of the first frame; times of a clip count from it."""
        return self.seconds[0]

    @property
    def from_first(self) -> Float64[np.ndarray, " S"]:
        """Seconds from the first frame."""
        return np.array([float(time - self.first) for time in self.seconds])

    @property
    def floats(self) -> Float64[np.ndarray, " S"]:
        """Seconds as the source counts them; nanoseconds of today are rounded to a quarter of a microsecond."""
        return np.array([float(time) for time in self.seconds])

    @property
    def digits(self) -> int:
        """The most digits after the point."""
        return min(_MOST_DIGITS, max(-int(time.as_tuple().exponent) for time in self.seconds))


def frame_times(paths: Sequence[Path], pictures: Sequence[str]) -> FrameTimes | None:
    """Return the times of picture files, of a list beside or above them or of their names; None where none tells.

    A list has a name of `LISTS`. It has times alone, one for each picture of the folder, or columns, one of which names
    the pictures (or numbers them as their names do); a time is a number or a date and time of day. The unit is the one
    that the heading of the column or the first lines name, the one in which times since 1970 are of our years, or the
    largest in which frames follow each other as in a film. Times that do not increase from frame to frame are none; a
    warning says why a list is not used.

    Args:
        paths: the files, in the order of the frames.
        pictures: the names of all pictures in their folder, in order; read where a list has times alone.

    Raises InputError for a list that is very large or cannot be read.
    """
    folders = {path.parent for path in paths}
    if len(folders) == 1:
        (folder,) = folders
        for path in [*_lists(folder), *_lists(folder.parent)]:
            found = _listed(path, [path.name for path in paths], pictures)
            if isinstance(found, FrameTimes):
                return found
            if found:
                logger.warning("%s is not used: %s", path, found)
    return _named([path.stem for path in paths])


def name_times(names: Sequence[str]) -> Float64[np.ndarray, " S"] | None:
    """Return the seconds that the names of frames state, None where they state none."""
    found = _named(names)
    return None if found is None else found.floats


def in_seconds(times: Float[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Return times since 1970 that are in milliseconds, microseconds or nanoseconds as seconds; others as they are."""
    times = np.asarray(times, np.float64)
    with np.errstate(invalid="ignore"):
        for digits in _UNITS.values():
            if len(times) and (times >= float(_FIRST) * 10**digits).all() and (times < float(_LAST) * 10**digits).all():
                return times / 10**digits
    return times


def _named(names: Sequence[str]) -> FrameTimes | None:
    if any(map(_CUT_PARTS.search, each := [_TWO_PARTS.sub(r"\1.\2", name) for name in names])):
        return None
    names = each
    if all(map(_SECONDS.fullmatch, names)):
        return _increasing([Decimal(name) for name in names], "the names of the frames, in seconds")
    found = [_SINCE_1970.findall(name) for name in names]
    if any(len(each) != 1 or (_DATE.match(each[0]) and "." not in each[0]) for each in found):
        return None
    times = [Decimal(each[0]) for each in found]
    if (unit := _unit_since_1970(times)) is None:
        return None
    seconds = [time.scaleb(-_UNITS[unit]) for time in times]
    return _increasing(seconds, f"the names of the frames, in {unit}") if _gap(seconds) <= _LONGEST else None


def _increasing(seconds: Iterable[Decimal], origin: str) -> FrameTimes | None:
    times = tuple(seconds)
    increase = all(after > before for before, after in pairwise(times))
    return FrameTimes(times, origin) if times and increase else None


def _unit_since_1970(times: Sequence[Decimal]) -> str | None:
    """Return the unit in which all times are of the years 1990 to 2100, if there is one."""
    return next(
        (unit for unit, digits in _UNITS.items() if all(_FIRST <= time.scaleb(-digits) < _LAST for time in times)), None
    )


def _gap(times: Sequence[Decimal]) -> Decimal:
    """Return the gap between frames that follow each other, in the middle; 0 for a single frame."""
    gaps = sorted(after - before for before, after in pairwise(times))
    return gaps[len(gaps) // 2] if gaps else Decimal(0)


def _lists(folder: Path) -> list[Path]:
    """Return the files of a folder that may be lists, the first of `LISTS` first."""
    try:
        found = {path.name.lower(): path for path in folder.iterdir() if path.name.lower() in LISTS}
    except OSError:  # a folder above that may not be listed
        found = {name: folder / name for name in LISTS}
    return [found[name] for name in LISTS if name in found and found[name].is_file()]


def _listed(path: Path, names: Sequence[str], pictures: Sequence[str]) -> FrameTimes | str:
    """Return the times of a list for files of these names; else why it tells none, "" for a list of something else."""
    with reading(path):
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path} has more than {_MOST_BYTES} bytes; expected a line for each frame")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    found: list[FrameTimes | str] = [_of_table(path, text[:1000], *table, names, pictures) for table in _tables(text)]
    return next((times for times in found if isinstance(times, FrameTimes)), found[0])


def _tables(text: str) -> Iterator[tuple[list[str], list[list[str]]]]:
    """Yield the names of a list's columns, if any, and its rows, in each way in which its lines may be split."""
    lines = [line for line in text.splitlines() if line.strip() and len(line) < _LONGEST_LINE]
    comments = [line.lstrip("# \t") for line in takewhile(lambda line: line.lstrip().startswith("#"), lines)]
    lines = [content for line in lines if (content := line.partition("#")[0].strip())]
    mark = next((mark for mark in ";," if lines and mark in lines[0]), None)

    def split(line: str) -> list[str]:
        return _joined(line.split()) if mark is None else [word.strip().strip('"') for word in line.split(mark)]

    heading, rows = split(_BEFORE_UNIT.sub("", comments[-1])) if comments else [], [split(line) for line in lines]
    if len(rows) > 1 and all(_read(word) is None for word in rows[0]):
        heading, rows = split(_BEFORE_UNIT.sub("", lines[0])), rows[1:]
    yield heading, rows
    if mark is None and any(len(row) > 2 for row in rows):  # names with blanks
        yield heading, [[row[0], " ".join(row[1:])] for row in rows]
        yield heading, [[" ".join(row[:-1]), row[-1]] for row in rows]


def _of_table(
    path: Path, start: str, heading: list[str], rows: list[list[str]], names: Sequence[str], pictures: Sequence[str]
) -> FrameTimes | str:
    """Return what `_listed` does for the rows of a list; its first letters, `start`, may state the unit."""
    width = min(map(len, rows), default=0)
    read = [[_read(row[place]) for row in rows] for place in range(width)]
    columns = [[time for time in column if time is not None] for column in read]
    times = {place: column for place, column in enumerate(columns) if len(column) == len(rows)}
    if not times:
        best = max(range(width), key=lambda place: len(columns[place]), default=0)
        if not rows or (path.suffix.lower() == ".csv" and not columns[best]):
            return "" if rows else "it has no line with a time"
        line = read[best].index(None)
        return f"its row {line + 1} has {one_line(rows[line][best], 60)!r}; expected a time"
    if width == 1 and len(rows) != len(pictures):
        return f"it has {len(rows)} times for {len(pictures)} pictures"
    keys = {at: [row[at] for row in rows] for at in range(width) if {*times} - {at}} or {-1: pictures}
    found = {at: _lines_of(names, column) for at, column in keys.items()}
    at = min(found, key=lambda at: (found[at].count(None), at in times))
    lines = [line for line in found[at] if line is not None]
    if len(lines) != len(names):
        return f"it names no {one_line(names[found[at].index(None)], 60)!r}"
    if path.suffix.lower() == ".csv" and width == len(heading) > 2:
        headed = any(re.search(pattern, word.lower()) for pattern in _HEADINGS for word in heading)
        if not headed:
            return "none of its columns is headed as times, as by timestamp"
    place = _time_column({place: column for place, column in times.items() if place != at}, heading)
    is_headed = len(heading) == len(rows[0]) and any(map(_STATED.search, heading))
    stated = _STATED.findall(heading[place] if is_headed else start)
    unit = _SHORT[stated[0]] if stated else _unit(times[place])
    seconds = tuple(times[place][line].scaleb(-_UNITS[unit]) for line in lines)
    for name, (before, after) in zip(names[1:], pairwise(seconds), strict=True):
        if after <= before:
            return f"it gives {one_line(name, 60)!r} no later time than the frame before"
    return FrameTimes(seconds, f"{path.name}, in {unit}")


def _lines_of(names: Sequence[str], keys: Sequence[str]) -> list[int | None]:
    """Return the place of each file's key: its name, the name without its ending, or the number that the latter is."""
    keys = [key.replace("\\", "/").rpartition("/")[2] for key in keys]
    known: dict[str | int, int] = {int(key): line for line, key in enumerate(keys) if key.isdecimal()}
    known |= {key.rpartition(".")[0]: line for line, key in enumerate(keys) if "." in key and _read(key) is None}
    known |= {key: line for line, key in enumerate(keys)}
    stems = [name.rpartition(".")[0] for name in names]
    numbers = [int(stem) if stem.isdecimal() else stem for stem in stems]
    ways = zip(names, stems, numbers, strict=True)
    return [next((known[key] for key in way if key in known), None) for way in ways]


def _time_column(times: Mapping[int, Sequence[Decimal]], heading: Sequence[str]) -> int:
    """Return the column that is headed as times; else the first that does not count on by one."""
    for pattern in _HEADINGS:
        for place in times:
            if place < len(heading) and re.search(pattern, heading[place].lower()):
                return place
    steps = {place: {after - before for before, after in pairwise(column)} for place, column in times.items()}
    return next((place for place in times if steps[place] != {1}), next(iter(times)))


def _unit(times: Sequence[Decimal]) -> str:
    """Return the unit of the times of a list that names none."""
    if (unit := _unit_since_1970(times)) is not None:
        return unit
    gaps = sorted(after - before for before, after in pairwise(sorted(times)))
    is_steady = len(gaps) > 1 and gaps[3 * len(gaps) // 4] <= _STEADY * gaps[len(gaps) // 4]
    is_whole = all(time == time.to_integral_value() for time in times)
    most, gap = _FILMED if is_whole or is_steady else _APART, _gap(sorted(times))
    return next((unit for unit, digits in _UNITS.items() if gap.scaleb(-digits) <= most), "seconds")


def _joined(words: list[str]) -> list[str]:
    """Return the words of a line with a date and a time of day as one word."""
    for place, (day, hour) in enumerate(pairwise(words)):
        if _read(f"{day} {hour}") is not None and _read(day) is None:
            return [*words[:place], f"{day} {hour}", *words[place + 2 :]]
    return words


def _read(word: str) -> Decimal | None:
    """Return a number, or the seconds since 1970 of a date and time of day in UTC."""
    if _NUMBER.fullmatch(word):
        try:
            return Decimal(word)
        except InvalidOperation:
            return None
    if (match := _MOMENT.fullmatch(word)) is None:
        return None
    day, hour, fraction, zone = match.groups()
    try:
        moment = datetime.fromisoformat(f"{day}T{hour}{zone or 'Z'}")
    except ValueError:
        return None
    return Decimal(int(moment.timestamp())) + Decimal(f"0.{fraction or 0}")
