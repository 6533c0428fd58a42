"""The natural order of file names: frame_2 before frame_10, and times in seconds by value."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

Item = TypeVar("Item")

_MOST_DIGITS = 1000  # of a number; Python reads some 4000 and refuses more
_WHOLE = re.compile(r"(\d+)")
_DECIMAL = re.compile(r"((?<![\d.])\d+\.\d+(?!\d|\.\d|gp$)|\d+)")  # not of 1.2.3, nor of 1.3gp


def in_order(items: Iterable[Item], path: Callable[[Item], Path] = lambda item: item) -> list[Item]:  # type: ignore[return-value]
    """Return items in the natural order of their paths, or of their paths as texts where these tie.

    Runs of digits in each part of a path are numbers. Where names are decimal times (1700000000.05, .1, .15), the whole
    number counts; names such as 1.9 and 1.10, whose second number counts on, are no decimals.
    """
    items = list(items)
    numbers = _DECIMAL if _are_decimal([path(item).name for item in items]) else _WHOLE
    return sorted(items, key=lambda item: (_key(path(item), numbers), str(path(item))))


def _key(path: Path, numbers: re.Pattern[str]) -> list[list[Any]]:
    return [
        *([_value(piece) for piece in _WHOLE.split(part)] for part in path.parts[:-1]),
        [_value(piece) for piece in numbers.split(path.name)],
    ]


def _value(piece: str) -> str | int | float | Decimal:
    if not re.fullmatch(r"\d+(\.\d+)?", piece):
        return piece.casefold()
    if len(piece) > _MOST_DIGITS:  # of no file, but of a name in a file
        return math.inf
    return int(piece) if piece.isdecimal() else Decimal(piece)


def _are_decimal(names: list[str]) -> bool:
    """Return whether the digits after a point are fractions, which lose their last zeros, and not counted on.

    A fraction with a zero in front, as in .05, is never counted; and a count of over nine has a 10.
    """
    fractions = [piece.partition(".")[2] for name in names for piece in _DECIMAL.findall(name) if "." in piece]
    if len(set(map(len, fractions))) < 2:  # either way the order is the same
        return bool(fractions)
    several = [fraction for fraction in fractions if len(fraction) > 1]
    return any(fraction[0] == "0" for fraction in several) or not any(fraction[-1] == "0" for fraction in several)
