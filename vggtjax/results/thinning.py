"""Thinning a stream of points evenly in space, in bounded memory: of each voxel the most confident point is kept."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt64

_FINEST = 2048  # voxels along an axis: three indices and a confidence fit in 64 bits
_INDEX_BITS, _CONFIDENCE_BITS = np.uint64(11), np.uint64(31)
_SLACK = 4  # points held at most, in budgets
_HALVINGS = 6  # of the interval of the voxels' size; after them the count is within a few percent of the budget


class Candidates(NamedTuple):
    """Points that may be kept."""

    positions: Float32[np.ndarray, "N 3"]
    places: Float32[np.ndarray, "N 3"]  # in [0, 1); voxels divide this cube
    confidence: Float32[np.ndarray, " N"]
    frames: Int32[np.ndarray, " N"]
    pixels: Int32[np.ndarray, " N"]

    def take(self, chosen: Int[np.ndarray, " M"] | Bool[np.ndarray, " N"]) -> Candidates:
        return Candidates(*(field[chosen] for field in self))


class EvenThinning:
    """Takes points chunk by chunk and keeps at most `budget` of them; all of them where there are no more.

    Voxels are as small as the budget allows; of each the most confident point is kept, of equals the first. The same
    points in the same order give the same choice.
    """

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._chunks: list[Candidates] = []
        self._count = 0
        self._cells = _FINEST

    def add(self, points: Candidates) -> None:
        """Take more points, at most a few budgets of which are held."""
        if self._budget and len(points.pixels):
            self._chunks.append(points)
            self._count += len(points.pixels)
            if self._count > _SLACK * self._budget:
                self._reduce()

    def kept(self) -> Candidates | None:
        """Return the points that are kept, in the order in which they came; None without any."""
        if self._count > _SLACK // 2 * self._budget:
            self._reduce()
        if not self._chunks:
            return None
        points = _joined(self._chunks)
        return points if self._count <= self._budget else points.take(self._fitting(points))

    def _reduce(self) -> None:
        """Keep a point a voxel, and double the voxels until half of the room is free: nested voxels lose nothing."""
        points = _joined(self._chunks)
        while True:
            points = points.take(_most_confident(points, self._cells))
            if len(points.pixels) <= _SLACK // 2 * self._budget or self._cells == 1:
                break
            self._cells //= 2
        self._chunks, self._count = [points], len(points.pixels)

    def _fitting(self, points: Candidates) -> Int[np.ndarray, " M"]:
        """Return the most confident points of the smallest voxels that the budget allows, to a few percent."""
        many = few = float(self._cells)
        chosen = _most_confident(points, few)
        while len(chosen) > self._budget:
            many, few = few, few / 2
            chosen = _most_confident(points, few)
        for _ in range(_HALVINGS if many > few else 0):
            middle = (many + few) / 2
            found = _most_confident(points, middle)
            if len(found) > self._budget:
                many = middle
            else:
                few, chosen = middle, found
        return chosen


def _joined(chunks: list[Candidates]) -> Candidates:
    return chunks[0] if len(chunks) == 1 else Candidates(*map(np.concatenate, zip(*chunks, strict=True)))


def _most_confident(points: Candidates, cells: float) -> Int[np.ndarray, " M"]:
    """Return the most confident point of each occupied voxel, of `cells` along an axis, in the order of the points."""
    keys = _keys(points, cells)
    order = np.argsort(keys)  # the order of equal keys depends on the machine
    keys = keys[order]
    voxels = keys >> _CONFIDENCE_BITS
    (starts,) = np.nonzero(np.diff(voxels, prepend=~voxels[:1]))
    best = np.repeat(keys[starts], np.diff(starts, append=len(keys)))
    return np.sort(np.minimum.reduceat(np.where(keys == best, order, len(keys)), starts))


def _keys(points: Candidates, cells: float) -> UInt64[np.ndarray, " N"]:
    """Return numbers that sort the points by voxel, and those of a voxel from the most to the least confident."""
    keys = np.zeros(len(points.pixels), np.uint64)
    for axis in range(3):
        keys = (keys << _INDEX_BITS) | np.floor(points.places[:, axis] * np.float32(cells)).astype(np.uint64)
    confidence = np.maximum(points.confidence, np.float32(0)) + np.float32(0)  # -0 becomes 0
    rank = confidence.view(np.uint32).astype(np.uint64)  # the bits of floats above 0 are in the order of the floats
    return (keys << _CONFIDENCE_BITS) | ((np.uint64(1) << _CONFIDENCE_BITS) - np.uint64(1) - rank)


def places_in_cube(
    positions: Float[np.ndarray, "N 3"], middle: Float[np.ndarray, " 3"], radius: float
) -> Float32[np.ndarray, "N 3"]:
    """Map all space into the cube [0, 1): evenly up to `radius` around `middle`, ever coarser beyond.

    A point at distance d beyond the radius r goes to the distance 2 r - r^2 / d, so that a far background takes no more
    voxels than its size in the pictures deserves.
    """
    offset = (positions - middle) / radius
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    far = np.maximum(distance, 1)
    places = (offset * ((2 - 1 / far) / far) + 2) / 4
    return places.clip(0, np.nextafter(np.float32(1), np.float32(0))).astype(np.float32)
