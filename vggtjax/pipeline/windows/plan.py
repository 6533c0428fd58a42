"""Which frames each window of a long clip has, or of frames that are added to a result. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vggtjax.errors import InputError, whole_number

LEAST_OVERLAP = 2  # frames; one frame tells nothing of how cameras move
FEWEST_ANCHORS = 3
SAME_PLACE = 0.4  # overlap of frames that show one place, as `windows.overlap` measures it


@dataclass(frozen=True)
class Windows:
    """How a long clip is cut: without a window, or with window 0, not at all. Raises InputError for a bad value.

    Attributes:
        window: run the clip in windows of this many frames, at least 4, and join them: memory then does not depend on
            the clip's length; 0 runs all frames together; by default they are run together where they fit in memory,
            else in windows of up to 64
        overlap: frames that neighbouring windows share, at least 2 and at most half a window; a quarter of a window by
            default
        no_loops: no loop closure: do not join windows in which the camera comes back to the same place
    """

    window: int | None = None
    overlap: int | None = None
    no_loops: bool = False

    def __post_init__(self) -> None:
        if self.window is None or self.window == 0:
            if self.overlap is not None:
                raise InputError(f"overlap is {self.overlap}, but there are no windows; give window too")
            return
        object.__setattr__(self, "window", whole_number("window", self.window, 2 * LEAST_OVERLAP))
        given = max(LEAST_OVERLAP, self.window // 4) if self.overlap is None else self.overlap
        object.__setattr__(self, "overlap", whole_number("overlap", given, LEAST_OVERLAP))
        if self.window < 2 * self.shared:
            raise InputError(
                f"window is {self.window} and overlap is {self.shared}; expected a window of at least twice the overlap"
            )

    @property
    def shared(self) -> int:
        """Frames that neighbouring windows share at least."""
        return LEAST_OVERLAP if self.overlap is None else self.overlap

    def cuts(self, frames: int) -> bool:
        """Return whether a clip of this many frames is cut: it is longer than a window."""
        return bool(self.window) and frames > self.window


@dataclass(frozen=True)
class Extending:
    """How frames are added to a result. Raises InputError for a bad value.

    Attributes:
        prefix: letters before the names of the new frames, such as day2_, where they have names of old ones
        window: frames that are run together, anchors and new ones; more than --anchors
        anchors: how many of them are frames that are known already, at least 3
        least_overlap: new frames whose overlap with known frames is less than this, between 0 and 1, count as another
            place; the default was chosen with the demonstration model only
    """

    prefix: str = ""
    window: int = 32
    anchors: int = 8
    least_overlap: float = SAME_PLACE

    def __post_init__(self) -> None:
        whole_number("anchors", self.anchors, FEWEST_ANCHORS)
        whole_number("window", self.window, self.anchors + 1)
        if not 0 < self.least_overlap < 1:
            raise InputError(f"least_overlap is {self.least_overlap}; expected a number between 0 and 1")

    def parts(self, frames: int) -> list[range]:
        """Return the new frames of each window."""
        length = self.window - self.anchors
        return [range(start, min(start + length, frames)) for start in range(0, frames, length)]


def plan_windows(frames: int, window: int, overlap: int) -> list[range]:
    """Return the frames of each window: all of one length, so that one compiled program runs them all.

    There are as few windows as `overlap` allows. They are spread evenly, so that the last is as long as the others, and
    neighbours share at least `overlap` frames.

    Args:
        frames: of the clip, more than `window`.
        window: frames of a window.
        overlap: the least number of frames that neighbours share, at most half a window.
    """
    last = frames - window
    count = -(-last // (window - overlap)) + 1
    starts = [number * last // (count - 1) for number in range(count)]
    return [range(start, start + window) for start in starts]


def blend_weights(frame: int, windows: Sequence[range]) -> dict[int, float]:
    """Return the weight of each window that has a frame, by number; they sum to 1.

    A window weighs the less the nearer the frame is to its end, so that depth and cameras change without a step where a
    window begins or ends.
    """
    inside = {number: min(frame - w.start, w.stop - 1 - frame) + 1 for number, w in enumerate(windows) if frame in w}
    total = sum(inside.values())
    return {number: depth / total for number, depth in inside.items()}


def shared_frames(first: range, second: range) -> range:
    """Return the frames that two windows share."""
    return range(max(first.start, second.start), max(min(first.stop, second.stop), max(first.start, second.start)))
