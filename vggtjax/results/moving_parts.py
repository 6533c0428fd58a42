"""Parts of what moves, as places over time: those that touch and move alike are one object."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Float64, Int

_BETWEEN = 0.02  # of the picture's side: still pixels between parts that touch
_LIKE = 0.3  # most change of the place of one part beside another, in their size
_LATELY = 8  # frames in which this change counts; over more, parts of one object may turn about each other
_RESHAPED = 1.6  # area over the part's median, beyond which its centre says nothing of its motion
_USUAL = 0.9  # share of the frames in which parts have to move alike
_SIDE = 2.5  # side of a square, in median distances of its points from their centre


class _Seen(NamedTuple):
    """A part in a frame."""

    centre: Float64[np.ndarray, " D"]
    side: float
    area: int  # pixels


class MovingParts:
    """Where the parts of a clip are, and which of them touch."""

    def __init__(self) -> None:
        self._seen: dict[int, dict[int, _Seen]] = {}  # part -> frame -> where
        self._touching: dict[tuple[int, int], int] = {}  # pairs of parts -> number of frames
        self._joined: set[tuple[int, int]] = set()  # pairs that were one region in a frame

    def see(self, part: int, frame: int, places: Float[np.ndarray, "N D"]) -> None:
        """Note the places of the pixels of a part that is a region by itself."""
        known = places[np.isfinite(places).all(axis=1)].astype(np.float64)
        if len(known):
            centre = np.median(known, axis=0)
            side = max(_SIDE * float(np.median(np.linalg.norm(known - centre, axis=1))), 1e-12)
            self._seen.setdefault(part, {})[frame] = _Seen(centre, side, len(places))

    def touch(self, ids: Int[np.ndarray, "H W"], joined: Collection[set[int]]) -> None:
        """Note which parts of a frame touch, and which of them are one region."""
        if len(np.unique(ids)) < 3:  # a single part, and what stands still
            return
        window = 2 + max(1, round(_BETWEEN * np.sqrt(ids.size)))
        high = scipy.ndimage.maximum_filter(ids, window)
        low = scipy.ndimage.minimum_filter(np.where(ids > 0, ids, np.iinfo(ids.dtype).max), window)
        meets = (high > 0) & (low < high)
        for a, b in np.unique(np.stack([low[meets], high[meets]], axis=1), axis=0).tolist():
            self._touching[a, b] = self._touching.get((a, b), 0) + 1
            if any({a, b} <= region for region in joined):
                self._joined.add((a, b))

    def objects(self, parts: int) -> list[int]:
        """Return the object of each of the parts 1, 2, ...: the number of its first part. The list starts with 0.

        The parts that touch longest are joined first. No two parts of an object differ in their motion.
        """
        groups = [[part] for part in range(parts + 1)]
        for a, b in sorted(self._touching, key=lambda pair: (-self._touching[pair], pair)):
            first, second = groups[a], groups[b]
            if first is second or not self._are_one(a, b) or any(self._differ(i, j) for i in first for j in second):
                continue
            first.extend(second)
            for part in second:
                groups[part] = first
        return [min(group) for group in groups]

    def _both(self, a: int, b: int) -> tuple[Int[np.ndarray, " N"], list[_Seen], list[_Seen]]:
        """Return the frames in which both parts have about their usual area, and both parts there."""
        ours, theirs = ({} if part not in self._seen else _in_shape(self._seen[part]) for part in (a, b))
        frames = sorted(ours.keys() & theirs.keys())
        return np.array(frames, int), [ours[frame] for frame in frames], [theirs[frame] for frame in frames]

    def _are_one(self, a: int, b: int) -> bool:
        """Return whether it is seen that parts belong together: as one region, or near each other in several frames."""
        frames, ours, theirs = self._both(a, b)
        if len(frames) < 2:
            return (a, b) in self._joined
        distance = np.median(np.linalg.norm(_centres(ours) - _centres(theirs), axis=1))
        return bool(distance <= _side(ours) + _side(theirs))  # not behind each other

    def _differ(self, a: int, b: int) -> bool:
        """Return whether the place of one part beside the other changes."""
        frames, ours, theirs = self._both(a, b)
        if len(frames) < 2:
            return False
        beside, most = _centres(ours) - _centres(theirs), _LIKE * np.sqrt(_side(ours) * _side(theirs))
        low, high = np.quantile(np.linalg.norm(beside, axis=1), [1 - _USUAL, _USUAL])
        if high - low > most:
            return True
        for lag in range(1, min(_LATELY, len(frames) - 1) + 1):
            changes = np.linalg.norm(beside[lag:] - beside[:-lag], axis=1)[frames[lag:] - frames[:-lag] <= _LATELY]
            if len(changes) and np.quantile(changes, _USUAL) > most:
                return True
        return False


def _in_shape(seen: dict[int, _Seen]) -> dict[int, _Seen]:
    usual = float(np.median([one.area for one in seen.values()]))
    return {frame: one for frame, one in seen.items() if usual / _RESHAPED < one.area < usual * _RESHAPED}


def _centres(seen: list[_Seen]) -> Float64[np.ndarray, "N D"]:
    return np.stack([one.centre for one in seen])


def _side(seen: list[_Seen]) -> float:
    return float(np.median([one.side for one in seen]))
