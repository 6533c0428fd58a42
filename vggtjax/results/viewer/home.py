"""Where the first view stands: what moves and most of what stands still are in it, and what moves is not hidden."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from vggtjax.results.frame import frame_of
from vggtjax.results.result import Result

# Behind and above the camera of the clip, in median depths. The first place from which all is seen is taken.
_PLACES = ((0.35, 0.16), (0.8, 0.3), (0.35, 0.6), (0.8, 0.9), (1.5, 0.6), (1.5, 1.5), (3.0, 1.5), (3.0, 3.0))
_MOST = 0.75  # of the static points, and of the frames' movers, are to be in the view
_MARGIN = 0.9  # of the way from the middle of the view to its edge: movers are within it
_WIDER, _WIDEST = 1.4, 1.2  # most growth of the view; tangent of half a field of view, beyond which it does not grow
_FRAMES, _POINTS = 32, 2000  # looked at; of each frame
_HIDE, _BESIDE, _NEARER = 3, 0.03, 0.9  # so many static points hide a mover, at tangents beside it, nearer by a share


class Place(NamedTuple):
    """Where a result's world lies in the page's: x -> scale * rotation x + offset."""

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, " 3"]

    def points(self, points: Float[np.ndarray, "*N 3"]) -> Float32[np.ndarray, "*N 3"]:
        with np.errstate(over="ignore"):  # worlds of untrained weights
            return (self.scale * (points @ self.rotation.T) + self.offset).astype(np.float32)


SAME_PLACE = Place(1.0, np.eye(3), np.zeros(3))


def median_depth(result: Result, number: int = 0) -> float:
    frame = frame_of(result, number)
    return float(np.median(frame.depth[frame.valid].astype(np.float64))) if frame.valid.any() else 1.0


def tangents(result: Result) -> Float[np.ndarray, "S 2"]:
    """Return the tangents of half the fields of view, of the width and of the height."""
    _, H, W = result.depth.shape
    return np.array([W, H]) / 2 / result.intrinsics[:, [0, 1], [0, 1]]


def home_view(result: Result, place: Place) -> dict[str, Any]:
    """Return the first view: behind and above the middle camera, along its axis.

    At the median depth it is as wide as the picture of that camera, so the film's framing fills the canvas, and the
    cameras lie low in the view, in front of what is near rather than of the subject. It is wider, or farther behind
    and above, where less than 3/4 of the static points, or of the frames' movers, would be in it and in sight.
    """
    number = len(result.depth) // 2
    axes = result.camera_from_world[number, :, :3].astype(np.float64) @ place.rotation.T
    centres = place.points(result.camera_centres).astype(np.float64)
    static, movers = (np.nan_to_num(place.points(points).astype(np.float64)) for points in _landmarks(result))
    depth = place.scale * median_depth(result, number)
    farthest_back = np.clip(-((centres - centres[number]) @ axes[2]).min(), 0, depth / 2)
    target = centres[number] + depth * axes[2]
    best, most_seen = None, -1.0
    for behind, above in _PLACES:
        eye = centres[number] - (behind * depth + farthest_back) * axes[2] - above * depth * axes[1]
        distance = max(float(np.linalg.norm(target - eye)), 1e-12)
        own = tangents(result)[number] * depth / distance
        down = np.cross((target - eye) / distance, axes[0])
        view = np.stack([axes[0], down, (target - eye) / distance])
        wide, seen = _widened(own, (static - eye) @ view.T, (movers - eye) @ view.T)
        if seen > most_seen:
            best, most_seen = {"eye": eye, "target": target, "up": -axes[1], "tangents": wide}, seen
        if seen == 1:
            break
    return {name: np.nan_to_num(value).tolist() for name, value in (best or {}).items()}


def _widened(
    own: Float[np.ndarray, " 2"], static: Float64[np.ndarray, "N 3"], movers: Float64[np.ndarray, "M 3"]
) -> tuple[Float[np.ndarray, " 2"], float]:
    """Return tangents of a view, its own or wider, and how much of what is wanted it shows: 1 is all.

    Points are in the view's camera: right, down, ahead. The last mover has to be seen.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        of_static, of_movers = (
            np.where(points[:, 2:] > 0, np.abs(points[:, :2] / points[:, 2:]) / own, np.inf).max(axis=1)
            for points in (static, movers)
        )
    of_movers /= _MARGIN
    wanted = [float(np.quantile(of, _MOST, method="higher")) for of in (of_static, of_movers) if len(of)]
    wanted += of_movers[-1:].tolist()
    growth = max(1.0, min(max(wanted, default=1.0), _WIDER, _WIDEST / float(own.max())))
    seen = (of_static <= growth, (of_movers <= growth) & ~_hidden(static, movers))
    shares = [min(1.0, is_seen.mean() / _MOST) for is_seen in seen if len(is_seen)]
    return own * growth, float(np.prod(shares)) * (0.5 if len(movers) and not seen[1][-1] else 1.0)


def _hidden(static: Float64[np.ndarray, "N 3"], movers: Float64[np.ndarray, "M 3"]) -> Bool[np.ndarray, " M"]:
    """Return which movers have static points before them."""
    static = static[static[:, 2] > 0]
    seen_at = static[:, :2] / static[:, 2:]
    hidden = np.zeros(len(movers), bool)
    for number, mover in enumerate(movers):
        if mover[2] > 0:
            beside = np.abs(seen_at - mover[:2] / mover[2]).max(axis=1) < _BESIDE
            hidden[number] = np.count_nonzero(beside & (static[:, 2] < _NEARER * mover[2])) >= _HIDE
    return hidden


def _landmarks(result: Result) -> tuple[Float32[np.ndarray, "N 3"], Float32[np.ndarray, "M 3"]]:
    """Return some static points of the world, and the middle of what moves in each frame, then in all."""
    S = len(result.depth)
    static, movers = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    for number in np.unique(np.linspace(0, S - 1, min(S, _FRAMES)).round().astype(int)).tolist():
        frame = frame_of(result, number)
        points = frame.world_points()
        still = points[frame.valid & ~frame.dynamic_mask]
        static.append(still[:: -(-len(still) // _POINTS) or 1])
        moving = points[frame.valid & frame.dynamic_mask]
        if len(moving):
            movers.append(np.median(moving, axis=0, keepdims=True))
    if len(movers) > 1:
        movers.append(np.mean(movers[1:], axis=0))
    return np.concatenate(static), np.concatenate(movers)
