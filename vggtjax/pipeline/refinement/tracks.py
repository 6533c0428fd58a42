"""Tracks of static points: unions of pairwise matches, and where the dense depth puts them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float64, Int64

from vggtjax.pipeline.refinement.matches import Pair
from vggtjax.results.result import Result


class Tracks(NamedTuple):
    """Observations of N points: the point, the frame, and the position in pixels of the source."""

    points: Int64[np.ndarray, " M"]  # from 0 to N - 1
    frames: Int64[np.ndarray, " M"]
    positions: Float64[np.ndarray, "M 2"]

    @property
    def number(self) -> int:
        """Number of points."""
        return int(self.points.max()) + 1 if len(self.points) else 0

    def chosen(self, chosen: Bool[np.ndarray, " M"]) -> Tracks:
        """Return some of the observations."""
        return Tracks(self.points[chosen], self.frames[chosen], self.positions[chosen])

    def long_enough(self, chosen: Bool[np.ndarray, " M"], least: int) -> Bool[np.ndarray, " M"]:
        """Return the chosen observations of points that have at least `least` of them."""
        return chosen & (np.bincount(self.points[chosen], minlength=self.number)[self.points] >= least)


def join_matches(
    positions: Sequence[Float64[np.ndarray, "N 2"]], matches: Mapping[Pair, Int64[np.ndarray, "K 2"]], least: int
) -> Tracks:
    """Return the connected features as tracks of at least `least` frames.

    A frame in which a track has two places is left out of that track.
    """
    sizes = [len(each) for each in positions]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    pairs = [found + starts[[a, b]] for (a, b), found in matches.items()]
    edges = np.concatenate([*pairs, np.zeros((0, 2), np.int64)])
    total = int(starts[-1])
    if not len(edges):
        return Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    graph = scipy.sparse.coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (total, total))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)
    frame = np.repeat(np.arange(len(sizes)), sizes)
    _, group, count = np.unique(label * len(sizes) + frame, return_inverse=True, return_counts=True)
    alone = count[group] == 1
    kept = alone & (np.bincount(label[alone], minlength=label.max() + 1)[label] >= least)
    points = np.unique(label[kept], return_inverse=True)[1]
    return Tracks(points, frame[kept], np.concatenate(positions)[kept])


def dense_depth_at(result: Result, tracks: Tracks) -> Float64[np.ndarray, " M"]:
    """Return the result's depth at each observation."""
    at = at_result_pixels(result, tracks)
    height, width = result.depth.shape[1:]
    column, row = np.clip(np.floor(at).astype(int), 0, [width - 1, height - 1]).T
    return result.depth[tracks.frames, row, column].astype(np.float64)


def starting_points(result: Result, tracks: Tracks) -> Float64[np.ndarray, "N 3"]:
    """Return the median, over its frames, of where the result's depth and cameras put each point."""
    K, pose = result.intrinsics[tracks.frames].astype(np.float64), result.camera_from_world[tracks.frames]
    rays = (at_result_pixels(result, tracks) - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    in_camera = np.column_stack([rays, np.ones(len(rays))]) * dense_depth_at(result, tracks)[:, None]
    placed = np.einsum("mji,mj->mi", pose[:, :, :3].astype(np.float64), in_camera - pose[:, :, 3])
    order = np.argsort(tracks.points, kind="stable")
    ends = np.cumsum(np.bincount(tracks.points))[:-1]
    return np.stack([np.median(of_point, axis=0) for of_point in np.split(placed[order], ends)])


def at_result_pixels(result: Result, tracks: Tracks) -> Float64[np.ndarray, "M 2"]:
    """Return the positions in pixels of the result."""
    return (tracks.positions - result.source_offset[tracks.frames]) / result.source_scale[tracks.frames]
