"""Two windows that share frames -> the similarity between their worlds, from static pixels and cameras.

The same pixel of the same frame is the same point, so a shared frame gives a pair of points for every pixel. Used are
pixels that are static by the masks of both windows and confident in both; the cameras of the shared frames add their
centres and directions. The fit is repeated with weights of Geman and McClure, so that pixels on which the windows
disagree lose their say. Does not import jax.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from vggtjax.cameras import Similarity, camera_centres, umeyama_sim3, unproject
from vggtjax.results.result import Result
from vggtjax.results.visible import inside_box, show_points

_PERCENTILE = 30.0  # percent of the pixels to leave out, the least confident of each window
_CAMERA_SHARE = 0.2  # of all weight: the cameras'; the pixels have the rest
_MOST_PIXELS = 50_000  # evenly spread
_LEAST_PIXELS = 64  # fewer shared pixels say less than the cameras do
_LEAST_SCALE = 0.01  # of the residuals, relative to depth: smaller ones are rounding or the grain of the depth
_ROUNDS = 30
_SETTLED = 1e-7  # change of the fit between rounds, relative
_NORMAL = 1.4826  # median of absolute values -> standard deviation


class Join(NamedTuple):
    """How the world of the second window lies in that of the first."""

    similarity: Similarity  # second -> first
    residual: float  # median distance of the used pixels after the fit, relative to their depth
    pixels: int  # that were used; 0: the cameras alone


class _Frames(NamedTuple):
    """What one window says of the shared frames."""

    points: Float64[np.ndarray, "F H W 3"]
    depth: Float64[np.ndarray, "F H W"]
    confidence: Float64[np.ndarray, "F H W"]
    valid: Bool[np.ndarray, "F H W"]
    moving: Bool[np.ndarray, "F H W"]
    poses: Float64[np.ndarray, "F 3 4"]


def join_windows(first: Result, second: Result, pairs: Sequence[tuple[int, int]]) -> Join:
    """Return how the second window's world lies in the first's.

    What either window says moves is left out. Where the windows share fewer than 64 static pixels, their cameras alone
    are used, with a scale from the depth of all shared pixels, and `pixels` is 0.

    Args:
        first, second: results of two windows, with frames of one size.
        pairs: numbers of the same frame in the first and in the second window.
    """
    numbers = np.asarray(pairs, int).reshape(-1, 2)
    a, b = _frames(first, numbers[:, 0]), _frames(second, numbers[:, 1])
    valid = a.valid & b.valid
    used = valid & ~(a.moving | b.moving)
    used &= _confident(a.confidence, used, _PERCENTILE) & _confident(b.confidence, used, _PERCENTILE)
    known = used if (count := int(used.sum())) >= _LEAST_PIXELS else valid
    reach_a, reach_b = _reaches(a, b, known)
    camera_a, camera_b = _camera_points(a.poses, reach_a), _camera_points(b.poses, reach_b)
    if count < _LEAST_PIXELS:
        found = umeyama_sim3(camera_b, camera_a, allow_line=True)
        return Join(found, _median_residual(found, camera_b, camera_a, np.full(len(camera_a), reach_a)), 0)
    chosen = np.flatnonzero(used.ravel())
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), _MOST_PIXELS)).round().astype(int)]
    target, source = (np.concatenate([w.points.reshape(-1, 3)[chosen], c]) for w, c in ((a, camera_a), (b, camera_b)))
    depth = np.concatenate([a.depth.ravel()[chosen], np.full(len(camera_a), reach_a)])
    shares = np.concatenate(
        [
            np.full(len(chosen), (1 - _CAMERA_SHARE) / len(chosen)),
            np.full(len(camera_a), _CAMERA_SHARE / len(camera_a)),
        ]
    )
    found = _robust(source, target, depth, shares)
    pixels = slice(0, len(chosen))
    return Join(found, _median_residual(found, source[pixels], target[pixels], depth[pixels]), count)


def reach_of(result: Result) -> float:
    """Return the median depth of a window's valid pixels: a length in its world; 1 without any."""
    valid = result.valid_pixels
    return float(np.median(result.depth[valid])) if valid.any() else 1.0


def _robust(
    source: Float64[np.ndarray, "N 3"],
    target: Float64[np.ndarray, "N 3"],
    depth: Float64[np.ndarray, " N"],
    shares: Float64[np.ndarray, " N"],
) -> Similarity:
    """Return the similarity of least robust error: distances relative to depth, weighted anew in every round."""
    base = shares / depth**2
    weights = base
    found = umeyama_sim3(source, target, weights=weights, allow_line=True)
    for _ in range(_ROUNDS):
        residual = np.linalg.norm(found.apply(source) - target, axis=1) / depth
        scale = max(_NORMAL * float(np.median(residual)), _LEAST_SCALE)
        weights = base / (1 + (residual / scale) ** 2) ** 2
        earlier, found = found, umeyama_sim3(source, target, weights=weights, allow_line=True)
        moved = np.linalg.norm(found.apply(source) - earlier.apply(source), axis=1) / depth
        if moved.max() < _SETTLED:
            break
    return found


def _median_residual(
    found: Similarity,
    source: Float64[np.ndarray, "N 3"],
    target: Float64[np.ndarray, "N 3"],
    depth: Float64[np.ndarray, " N"],
) -> float:
    return float(np.median(np.linalg.norm(found.apply(source) - target, axis=1) / depth))


def _frames(result: Result, numbers: np.ndarray) -> _Frames:
    depth = np.asarray(result.depth[numbers], np.float64)
    confidence = np.asarray(result.depth_confidence[numbers], np.float64)
    poses = result.camera_from_world[numbers].astype(np.float64)
    intrinsics = result.intrinsics[numbers].astype(np.float64)
    inside = inside_box(result.valid_box[numbers], result.depth.shape[1:])
    valid = show_points(result.depth[numbers], result.depth_confidence[numbers], inside)
    points = unproject(depth, intrinsics, poses, pixel_offset=0.5)
    valid &= np.isfinite(points).all(axis=-1)
    return _Frames(points, depth, confidence, valid, np.asarray(result.dynamic_mask[numbers]), poses)


def _confident(
    confidence: Float64[np.ndarray, "F H W"], used: Bool[np.ndarray, "F H W"], percentile: float
) -> Bool[np.ndarray, "F H W"]:
    """Return the pixels that are at least as confident as a percentage of those used."""
    return confidence >= (np.percentile(confidence[used], percentile) if used.any() else 0)


def _reaches(a: _Frames, b: _Frames, known: Bool[np.ndarray, "F H W"]) -> tuple[float, float]:
    """Return a length in each world: the depth of the first, and the same in the second by the ratio of depths."""
    if not known.any():
        return 1.0, 1.0
    reach = float(np.median(a.depth[known]))
    return reach, reach * float(np.median(b.depth[known] / a.depth[known]))


def _camera_points(poses: Float64[np.ndarray, "F 3 4"], reach: float) -> Float64[np.ndarray, "N 3"]:
    """Return points that stand for cameras: the centre of each, and a point ahead, to its right and below it."""
    centres = camera_centres(poses)
    return np.concatenate([centres, *(centres + reach * poses[:, axis, :3] for axis in range(3))])
