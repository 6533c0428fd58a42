"""Static points that the result's tracks follow, and where each frame saw them: what was measured, for COLMAP."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from vggtjax.results.exports.views import View, rigid
from vggtjax.results.result import Result
from vggtjax.results.tracks import SEEN

_FEWEST = 2  # frames of a track


class TrackedPoints(NamedTuple):
    """Points of queries, where the depth of the queries' own frames puts them, and their tracks."""

    points: Float64[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    positions: Float64[np.ndarray, "S N 2"]  # pixels of the result's frames; pixel edges are at whole numbers
    seen: Bool[np.ndarray, "S N"]

    def in_picture(self, number: int, result: Result, view: View) -> tuple[np.ndarray, Float64[np.ndarray, "K 2"]]:
        """Return which points a frame saw, and where in its picture, which may have another size."""
        own, shown = result.intrinsics[number].astype(np.float64), view.frame.intrinsics
        scale = np.diag(shown)[:2] / np.diag(own)[:2]
        pixels = (self.positions[number] - own[:2, 2]) * scale + shown[:2, 2]
        height, width = view.size
        seen = self.seen[number] & ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        return np.flatnonzero(seen), pixels[seen]


def tracked_points(result: Result) -> TrackedPoints:
    """Return the tracked points of static, valid pixels that at least two frames saw; none without tracks."""
    positions, visibility, own = result.track_positions, result.track_visibility, result.track_frames
    S, H, W = result.depth.shape
    if positions is None or visibility is None or own is None:
        return TrackedPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((S, 0, 2)), np.zeros((S, 0), bool))
    query = positions[own, np.arange(len(own))].astype(np.float64)
    columns, rows = (np.clip(query[:, axis].astype(int), 0, side - 1) for axis, side in enumerate((W, H)))
    static = result.valid_pixels[own, rows, columns] & ~result.dynamic_mask[own, rows, columns]
    poses = np.stack([rigid(pose) for pose in result.camera_from_world])
    K = result.intrinsics[own].astype(np.float64)
    depth = result.depth[own, rows, columns].astype(np.float64)
    across = (query - K[:, :2, 2]) / np.stack([K[:, 0, 0], K[:, 1, 1]], axis=1)
    inside = np.column_stack([across, np.ones(len(own))]) * depth[:, None]
    points = np.einsum("nij,ni->nj", poses[own, :, :3], inside - poses[own, :, 3])
    away = np.einsum("sj,nj->sn", poses[:, 2, :3], points) + poses[:, 2, 3:]
    seen = (visibility >= SEEN) & (away > 0) & static
    kept = seen.sum(axis=0) >= _FEWEST
    colors = result.images[own, rows, columns]
    return TrackedPoints(points[kept], colors[kept], positions[:, kept].astype(np.float64), seen[:, kept])
