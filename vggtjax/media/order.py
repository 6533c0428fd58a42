"""The natural order of file names: frame_2 before frame_10."""

from __future__ import annotations

import math
import re
from pathlib import Path

_MOST_DIGITS = 1000  # of a number; Python reads some 4000 and refuses more


def natural_key(path: Path) -> list[list[str | float]]:
    """Return a key that sorts frame_2 before frame_10: runs of digits in each part of the path are numbers."""
    return [[_value(piece) for piece in re.split(r"(\d+)", part)] for part in path.parts]


def _value(piece: str) -> str | float:
    if not piece.isdecimal():
        return piece.casefold()
    return int(piece) if len(piece) <= _MOST_DIGITS else math.inf  # of no file, but of a name in a file
