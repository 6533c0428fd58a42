"""Points to track, each given in one frame of the clip. Does not import jax."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int64

from vggtjax.errors import InputError, one_line
from vggtjax.storage.csv_file import read_csv

if TYPE_CHECKING:
    from vggtjax.clips.clip import Clip

MOST_QUERIES = 10_000
_MOST_FILE_BYTES = 1 << 24


@dataclass(frozen=True, eq=False)
class Queries:
    """Points to track: x, y in pixels of the clip's frames, pixel edges at whole numbers; each in a frame of its own.

    Raises InputError for shapes that do not fit, no points, or more than MOST_QUERIES.
    """

    points: Float32[np.ndarray, "Q 2"]
    frames: Int64[np.ndarray, " Q"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.asarray(self.points, np.float32))
        object.__setattr__(self, "frames", np.asarray(self.frames, np.int64))
        count = len(self.frames)
        if self.points.shape != (count, 2) or self.frames.ndim != 1:
            raise InputError(
                f"points have shape {self.points.shape} and frames {self.frames.shape}; expected (Q, 2) and (Q,)"
            )
        if not 1 <= count <= MOST_QUERIES:
            raise InputError(f"there are {count} points to track; expected 1 to {MOST_QUERIES}")

    def check(self, frames: int, height: int, width: int) -> None:
        """Raise InputError unless every point lies in one of so many frames of that size."""
        inside = (self.points >= 0).all(axis=1) & (self.points <= [width, height]).all(axis=1)
        inside &= (self.frames >= 0) & (self.frames < frames)
        if not inside.all():
            first = int(np.argmin(inside))
            x, y = self.points[first]
            raise InputError(
                f"point {first} is at ({x:g}, {y:g}) in frame {self.frames[first]}; expected a place in frames 0 to "
                f"{frames - 1} of {width} x {height} pixels"
            )

    def moved(self, given: Clip, clip: Clip) -> Queries:
        """Return the same places of the source in the frames of another clip of the same source."""
        points = [
            clip.from_source(frame, given.to_source(frame, point))
            for frame, point in zip(self.frames.tolist(), self.points, strict=True)
        ]
        return Queries(np.array(points, np.float32), self.frames)


def check_words(text: str) -> None:
    """Raise InputError for words that `parse_queries` refuses for every clip."""
    if text.startswith("grid:"):
        _grid_side(text)
    elif not Path(text).is_file():
        raise InputError(f"tracks is {text[:200]!r}, and there is no such file; expected grid:N or a CSV file")


def parse_queries(text: str, clip: Clip) -> Queries:
    """Return the points to track in a clip that the words of a command line name.

    "grid:N" names N x N points spread over the first frame; other words name a CSV file with columns x, y and,
    optionally, frame (counted in frames of the clip, 0 by default), in pixels of the source.

    Raises InputError for other words, or points outside the frames.
    """
    check_words(text)
    if text.startswith("grid:"):
        return _grid(text, clip)
    points, frames = zip(*_places(Path(text), clip, len(clip)), strict=True)
    return Queries(np.array(points, np.float32), np.array(frames, np.int64))


def _grid(text: str, clip: Clip) -> Queries:
    number = _grid_side(text)
    left, top, right, bottom = clip.valid_box[0]
    share = (np.arange(number) + 0.5) / number
    x, y = np.meshgrid(left + share * (right - left), top + share * (bottom - top))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    return Queries(points.astype(np.float32), np.zeros(len(points), np.int64))


def _grid_side(text: str) -> int:
    number, most = text.removeprefix("grid:"), int(MOST_QUERIES**0.5)
    if not (number.isascii() and number.isdigit() and len(number) < 10 and 1 <= int(number) <= most):
        raise InputError(f"tracks is {text[:40]!r}; expected grid:N with N from 1 to {most}")
    return int(number)


def check_queries(text: str, clip: Clip, frames: int) -> None:
    """Raise InputError for points that `parse_queries` refuses, where `clip` is the beginning of one of so many frames.

    Places in later frames are not checked.
    """
    if not text.startswith("grid:"):
        deque(_places(Path(text), clip, frames), maxlen=0)


def _places(path: Path, clip: Clip, frames: int) -> Iterator[tuple[Float64[np.ndarray, " 2"], int]]:
    """Yield the points of a file in the frames of `clip`, and their frames; others are before frame `frames`."""
    rows = read_csv(path, most_bytes=_MOST_FILE_BYTES).rows
    if not rows:
        raise InputError(f"{path} holds no points; expected a line x,y,frame and then one line per point")
    for line, row in rows:
        shown = one_line(str(row))
        try:
            frame = int(row.get("frame") or 0)
            place = np.array([float(row["x"]), float(row["y"])])
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path} line {line} is {shown}; expected columns x, y and, if wanted, frame") from None
        if not 0 <= frame < frames or not np.isfinite(place).all():
            raise InputError(f"{path} line {line} is {shown}; expected numbers, and a frame from 0 to {frames - 1}")
        if frame >= len(clip):
            continue
        point = clip.from_source(frame, place)
        left, top, right, bottom = clip.valid_box[frame]
        if not (left <= point[0] <= right and top <= point[1] <= bottom):
            height, width = clip.source_size[frame]
            raise InputError(
                f"{path} line {line}: ({place[0]:g}, {place[1]:g}) lies outside what the model sees of frame {frame}, "
                f"a picture of {width} x {height}; expected a place inside (mode 'crop' cuts tall pictures, 'pad' "
                "does not: --preprocess pad)"
            )
        yield point, frame
