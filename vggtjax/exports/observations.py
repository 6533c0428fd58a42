"""Static points of a result, and the frames that see them: the tracks of a COLMAP model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from vggtjax.cameras import project
from vggtjax.exports.views import View, rigid
from vggtjax.results.frame import SAME_SURFACE
from vggtjax.results.result import Result
from vggtjax.results.shown import ShownPoints

_LONGEST = 12  # frames of a track: a point of a background that every frame sees needs no more


class Observations(NamedTuple):
    """Points, and pairs of a point and a frame that sees it, by frame."""

    points: Float64[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    frames: Int64[np.ndarray, " M"]
    indices: Int64[np.ndarray, " M"]  # of the points

    def of_frame(self, number: int) -> Int64[np.ndarray, " K"]:
        """Return the indices of the points that a frame sees."""
        start, end = np.searchsorted(self.frames, [number, number + 1])
        return self.indices[start:end]


def observe(result: Result, shown: ShownPoints) -> Observations:
    """Find the frames that see each point, up to twelve spread over the clip; its own frame is always one.

    A frame sees a point that falls on a static, valid pixel whose depth differs by at most 5 % from the point's.
    """
    points = shown.positions.astype(np.float64)
    seen = [_seen(result, number, points) for number in range(len(result.depth))]
    frames = np.concatenate([np.full(len(indices), number) for number, indices in enumerate(seen)])
    indices = np.concatenate(seen)
    chosen = _shortened(frames, indices, shown.frames)
    return Observations(points, shown.values(result.images), frames[chosen], indices[chosen])


def pixels_of(view: View, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 2"]:
    """Return where points fall in the picture of a view; pixel edges are at whole numbers."""
    return np.column_stack(project(points, view.camera_from_world, view.frame.intrinsics)[:2])


def _seen(result: Result, number: int, points: Float64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " K"]:
    depth = result.depth[number]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        column, row, z = project(points, rigid(result.camera_from_world[number]), result.intrinsics[number])
    height, width = depth.shape
    indices = np.flatnonzero((z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height))
    at = row[indices].astype(int), column[indices].astype(int)
    static = result.valid_pixels[number] & ~result.dynamic_mask[number]
    return indices[static[at] & _same_surface(depth[at], z[indices])]


def _same_surface(depth: Float32[np.ndarray, " K"], z: Float64[np.ndarray, " K"]) -> np.ndarray:
    return np.abs(depth - z) <= SAME_SURFACE * np.minimum(depth, z)


def _shortened(frames: np.ndarray, indices: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return which observations stay: the point's own frame, and others evenly spread over its track."""
    order = np.lexsort([frames, indices])
    starts = np.flatnonzero(np.diff(indices[order], prepend=-1))
    lengths = np.diff(starts, append=len(order))
    place = np.arange(len(order)) - np.repeat(starts, lengths)
    length = np.repeat(lengths, lengths)
    slot = place * _LONGEST // np.maximum(length, _LONGEST)
    first = np.diff(slot, prepend=-1) != 0
    first[starts] = True
    stays = (length <= _LONGEST) | first | (own[indices[order]] == frames[order])
    return np.sort(order[stays])


def view_observations(
    items: Iterator[View], observations: Observations
) -> Iterator[tuple[View, Int64[np.ndarray, " K"], Float64[np.ndarray, "K 2"]]]:
    """Yield each view with the indices of the points that it sees, and where they fall in its picture."""
    for number, view in enumerate(items):
        indices = observations.of_frame(number)
        yield view, indices, pixels_of(view, observations.points[indices])
