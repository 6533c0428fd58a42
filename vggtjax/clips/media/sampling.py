"""Which frames of a source make a clip, and what every source of frames offers. Does not import jax."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float32
from PIL import Image

from vggtjax.errors import ClipError, InputError, whole_number

Item = TypeVar("Item")

TIME_ROUNDING = 1e-3  # seconds; containers such as Matroska round presentation times to milliseconds


@dataclass(frozen=True)
class Frame:
    """One frame of a source: its name, its upright RGB image and, for a video or some captures, its time in seconds.

    Of frames that are given as floating point, `exact` has the values in [0, 1] before they are rounded to 8 bits.
    `index` is its number in the source, as `Sampling.start` counts.
    """

    name: str
    image: Image.Image
    time: float | None = None
    exact: Float32[np.ndarray, "H W 3"] | None = None
    index: int | None = None


@dataclass(frozen=True)
class Sampling:
    """Which frames of a source are taken. Raises InputError for a value out of range.

    Attributes:
        start: first frame to take, counted from 0 in frames of the source
        stride: take every n-th frame; every frame by default
        fps: take this many frames per second, by the times of the frames; for a video, an animation, or pictures with
            known times; excludes stride
        max_frames: take at most this many frames; all by default
        skip: frames to leave out, such as 0-2,17, counted as for start; none by default
    """

    start: int = 0
    stride: int | None = None
    fps: float | None = None
    max_frames: int | None = None
    skip: str | None = None

    def __post_init__(self) -> None:
        for name, lowest in (("start", 0), ("stride", 1), ("max_frames", 1)):
            if name == "start" or getattr(self, name) is not None:
                object.__setattr__(self, name, whole_number(name, getattr(self, name), lowest))
        _ = self._skipped
        if self.fps is None:
            return
        if isinstance(self.fps, bool) or not isinstance(self.fps, Real) or not 0 < self.fps < math.inf:
            raise InputError(f"fps is {self.fps!r}; expected a number of frames per second above 0")
        if self.step != 1:
            raise InputError(f"fps is {self.fps} and stride is {self.stride}, but they exclude each other; give one")
        object.__setattr__(self, "fps", float(self.fps))

    @property
    def step(self) -> int:
        """Frames of the source from one taken frame to the next, without `fps`."""
        return 1 if self.stride is None else self.stride

    @functools.cached_property
    def _skipped(self) -> tuple[range, ...]:
        """The frames to leave out. Raises InputError for text that is no list of frames."""
        if self.skip is None:
            return ()
        parts = [re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", part) for part in str(self.skip).split(",")]
        ranges = [range(int(part[1]), int(part[2] or part[1]) + 1) for part in parts if part]
        if len(ranges) < len(parts) or not all(ranges):
            raise InputError(f"skip is {self.skip!r}; expected numbers of frames, such as 0-2,17")
        return tuple(ranges)

    def takes(self, index: int) -> bool:
        """Return whether a frame of the source is not among those to leave out."""
        return not any(index in skipped for skipped in self._skipped)

    def indices(self, count: int) -> Sequence[int]:
        """Return the indices taken of `count` still frames. Raises InputError for `fps`, ClipError for a late start."""
        if self.fps is not None:
            raise InputError(
                f"fps is {self.fps}, but still images have no presentation times; leave fps out, or take every "
                "n-th image with stride"
            )
        if self.start >= count:
            raise ClipError(f"start is {self.start}, but the source has only {count} frames; expected below {count}")
        every = range(self.start, count, self.step)
        taken = [index for index in every if self.takes(index)] if self._skipped else every
        if not taken:
            raise ClipError(
                f"skip is {self.skip!r} and leaves no frame of {len(every)}; expected to leave one at least"
            )
        return taken[: self.max_frames]

    def select(self, frames: Iterable[tuple[float, Item]]) -> Iterator[tuple[int, float, Item]]:
        """Yield (index, time, item) of the frames taken; frames after the last one are not read.

        With `fps`, ticks are 1 / fps apart from the time of frame `start`. Each tick takes the first frame at or after
        it, and no frame is taken twice. `frames` are (presentation time in seconds, item) of every frame of the source,
        in order. Raises ClipError if there are no frames, or none from `start` on.
        """
        count, taken, tick, begin = 0, 0, 0, 0.0
        for index, (time, item) in enumerate(frames):
            count = index + 1
            if index < self.start:
                continue
            if index == self.start:
                begin = time
            if self.fps is None:
                wanted = (index - self.start) % self.step == 0
            else:
                passed = (time - begin + TIME_ROUNDING) * self.fps
                wanted = passed >= tick
                tick = max(tick, math.floor(passed) + 1)
            if wanted and self.takes(index):
                yield index, time, item
                taken += 1
                if taken == self.max_frames:
                    return
        if not count:
            raise ClipError("the source has no frames; expected at least one")
        if not taken and self.start < count:
            raise ClipError(f"skip is {self.skip!r} and leaves no frame of {count}; expected to leave one at least")
        if not taken:
            raise ClipError(f"start is {self.start}, but the source has only {count} frames; expected below {count}")


def before_it(frame: int) -> str:
    """Return what to do with a source that breaks off at a frame, counted in frames of the source."""
    return f"write it anew, or take only frames before {frame} (start, stride, max_frames)"


class Source(Protocol):
    """A source of frames that can be read again and again."""

    @property
    def name(self) -> str:
        """Of the clip, without the folders above it; empty for frames in memory."""
        ...

    def total(self, sampling: Sampling) -> int | None:
        """Return how many frames `sampling` takes, or None if only reading the source can tell."""
        ...

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes, one in memory at a time."""
        ...
