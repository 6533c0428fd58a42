"""Times of frames that files state: in their names, or in lists beside them. Does not import jax."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from vggtjax.errors import InputError, reading

logger = logging.getLogger(__name__)

LISTS = ("timestamps.txt", "times.txt", "data.csv")
_UNITS = {"seconds": 0, "milliseconds": 3, "microseconds": 6, "nanoseconds": 9}  # digits after the point of a second
_SHORT = {"[s]": "seconds", "[ms]": "milliseconds", "[us]": "microseconds", "[ns]": "nanoseconds"}
_SINCE_1970 = re.compile(r"(?<![\d.])(?:\d{19}|\d{16}|\d{13}|\d{10}(?:\.\d{1,9})?|\d{9}\.\d{1,9})(?![\d.])")
_DATE = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])")  # 20240102..., which is no count
_SECONDS = re.compile(r"\d{1,18}\.\d{1,18}")  # a whole name
_NUMBER = re.compile(r"[+-]?\d{1,25}(?:\.\d{0,25})?(?:[eE][+-]?\d{1,2})?")
_FIRST, _LAST = Decimal(631_152_000), Decimal(4_102_444_800)  # the years 1990 to 2100
_LONGEST = Decimal(3600)  # seconds from frame to frame, in the middle, of names that are times
_FILMED = Decimal(2)  # the same of whole numbers in a list, which may be in any unit
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

    A list is timestamps.txt, times.txt or EuRoC's data.csv. Its lines are "time name" or "name time", or times alone,
    one for each picture of the folder; a time is a number or a date and time of day. The unit is the one that the first
    lines name, the one in which times since 1970 are of our years, or the largest in which frames follow each other as
    in a film. Times that do not increase from frame to frame are none.

    Args:
        paths: the files, in the order of the frames.
        pictures: the names of all pictures in their folder, in order; read where a list has times alone.

    Raises InputError for a list that is very large or cannot be read.
    """
    folders = {path.parent for path in paths}
    if len(folders) == 1:
        (folder,) = folders
        lists = [place / name for place in (folder, folder.parent) for name in LISTS]
        for path in filter(Path.is_file, lists):
            if (found := _listed(path, [path.name for path in paths], pictures)) is not None:
                return found
            if path.suffix == ".txt":
                logger.warning("%s does not give each frame a later time than the one before; it is not used", path)
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


def _listed(path: Path, names: Sequence[str], pictures: Sequence[str]) -> FrameTimes | None:
    """Return the times of a list for files of these names; None where it is no such list."""
    with reading(path):
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path} has more than {_MOST_BYTES} bytes; expected a line for each frame")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = [line.partition("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [words for words in lines if words and len(" ".join(words)) < _LONGEST_LINE]
    if rows and len(rows[0]) > 1 and all(_read(word) is None for word in _joined(rows[0])):
        rows = rows[1:]  # names of the columns
    rows = [_joined(words) for words in rows]
    columns = ((0, None),) if rows and len(rows[0]) == 1 else ((0, 1), (1, 0))
    for time, name in columns:
        if any(len(words) <= max(time, name or 0) for words in rows):
            continue
        keys = pictures if name is None else [words[name].replace("\\", "/").rpartition("/")[2] for words in rows]
        times = [_read(words[time]) for words in rows]
        if len(keys) != len(times):
            continue
        known = dict(zip(keys, times, strict=True))
        known |= {key.rpartition(".")[0]: value for key, value in known.items() if "." in key and _read(key) is None}
        found = [known.get(each, known.get(each.rpartition(".")[0])) for each in names]
        every = [value for value in times if value is not None]
        if None not in found and len(every) == len(times):
            unit = _SHORT[next(short for short in _SHORT if short in text[:1000])] if _states(text) else _unit(every)
            seconds = [value.scaleb(-_UNITS[unit]) for value in found if value is not None]
            return _increasing(seconds, f"{path.name}, in {unit}")
    return None


def _states(text: str) -> bool:
    return any(short in text[:1000] for short in _SHORT)


def _unit(times: Sequence[Decimal]) -> str:
    """Return the unit of the times of a list that names none."""
    if (unit := _unit_since_1970(times)) is not None:
        return unit
    is_whole = all(time == time.to_integral_value() for time in times)
    most = _FILMED if is_whole else 5 * _FILMED
    gap = abs(_gap(sorted(times)))
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
    day, dot, fraction = word.partition(".")
    try:
        moment = datetime.strptime(day, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    if dot and not re.fullmatch(r"\d{1,9}", fraction):
        return None
    return Decimal(int(moment.timestamp())) + (Decimal(f"0.{fraction}") if dot else 0)
