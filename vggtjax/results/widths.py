"""How wide a point has to be drawn for its surface to hold together, in films, viewers and recordings."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy
from jaxtyping import Float32

from vggtjax.results.result import Result
from vggtjax.results.shown import ShownPoints

_OVERLAP = 1.42  # width of a disc over the distance of neighbours: four discs of a square leave no gap
_SPARSEST = 2.0  # pixels of its own picture: the widest that a disc gets where neighbours are far
_NEIGHBOURS = 4


def point_widths(result: Result, points: ShownPoints, *, thinning: float = 1.0) -> Float32[np.ndarray, " N"]:
    """Return the widths, in the world, of discs that reach the neighbouring points in the picture and in the cloud.

    A disc is at least as wide as its pixel's footprint, depth over focal length, and at most twice as wide: points
    alone in the air stay small.

    Args:
        result: the result that the points are of.
        points: by frame, as `shown_points` returns them.
        thinning: pixels for each point that is shown, at least 1; discs may be wider by its square root.
    """
    pixel, reach = np.zeros((2, len(points.pixels)), np.float32)
    frames, starts = np.unique(points.frames, return_index=True)
    for frame, (start, end) in zip(frames, pairwise([*starts, len(points.frames)]), strict=True):
        own = points.pixels[start:end]
        focal = result.intrinsics[frame, [0, 1], [0, 1]].min()
        pixel[start:end] = result.depth[frame].ravel()[own] / focal
        reach[start:end] = np.hypot(pixel[start:end], _steps(result.depth[frame]).ravel()[own])
    if len(points.positions) > _NEIGHBOURS:
        distance = scipy.spatial.KDTree(points.positions).query(points.positions, _NEIGHBOURS + 1, workers=-1)[0]
        reach = np.maximum(reach, distance[:, -1])
    widest = np.float32(_SPARSEST * max(thinning, 1.0) ** 0.5) * pixel
    return (_OVERLAP * np.clip(reach, pixel, widest)).astype(np.float32)


@np.errstate(invalid="ignore", over="ignore")
def _steps(depth: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Return the largest difference of each pixel's depth to its four neighbours'."""
    steps = np.zeros_like(depth)
    for axis in range(2):
        step = np.nan_to_num(np.abs(np.diff(depth, axis=axis)))
        before, after = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        steps[before] = np.maximum(steps[before], step)
        steps[after] = np.maximum(steps[after], step)
    return steps
