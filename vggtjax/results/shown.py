"""Which points of a result are shown in a viewer, a film or a report: confident, off the edges, in bounded numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from vggtjax.cameras import camera_centres
from vggtjax.errors import InputError, whole_number
from vggtjax.progress import Progress, no_progress
from vggtjax.results.frame import SAME_SURFACE, ResultFrame, frame_of
from vggtjax.results.point_cloud import PointCloud, least_confidence
from vggtjax.results.result import Result
from vggtjax.results.thinning import Candidates, EvenThinning, places_in_cube

POINT_LIMIT = 1_000_000  # viewers in a browser still turn so many points smoothly
MOST_STATIC, MOST_MOVING = 1_000_000, 50_000  # points of the clip, points of a frame
_STEEPEST = 8.0  # slope of a surface, away over across, beyond which neighbours belong to two: 83 degrees
_NEIGHBOURS = ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:]))  # pixels and the next ones, by axis


class ShownPoints(NamedTuple):
    """Points of the pixels of some frames, by frame and then by pixel."""

    positions: Float32[np.ndarray, "N 3"]  # in the world
    frames: Int32[np.ndarray, " N"]
    pixels: Int32[np.ndarray, " N"]  # row * W + column

    def values(self, array: np.ndarray) -> np.ndarray:
        """Return what an array of the clip, [S, H, W, ...], holds at the points: [N, ...]."""
        rows, columns = np.divmod(self.pixels, array.shape[2])
        return array[self.frames, rows, columns]

    def cloud(self, result: Result) -> PointCloud:
        """Return the points with the colours of the pictures."""
        return PointCloud(self.positions, self.values(result.images))


def shown_points(
    result: Result,
    *,
    static_percentile: float = 20.0,
    dynamic_percentile: float = 20.0,
    edges: float | None = SAME_SURFACE,
    most_static: int = MOST_STATIC,
    most_moving: int = MOST_MOVING,
    progress: Progress | None = None,
) -> tuple[ShownPoints, list[ShownPoints]]:
    """Choose the points to show: the static ones of all frames, and the moving ones of each frame, maybe none.

    Static points beyond the budget are thinned evenly in space: of each voxel the most confident one is kept, and
    voxels grow with the distance. Moving points are thinned evenly over the picture. The choice is always the same.

    Args:
        result: of a clip; 300 frames of 518 x 294 pixels take about half a minute of a core.
        static_percentile: percent of the static pixels, the least confident, to leave out.
        dynamic_percentile: the same for the moving ones.
        edges: leave out pixels whose depth differs by more than this share from a neighbour's, and static pixels beside
            moving ones; a coarse picture, where a floor has such steps too, is allowed slopes of up to 83 degrees. None
            leaves them in.
        most_static: points of all frames together.
        most_moving: points of a frame.
        progress: called with the number of frames done, and of all.

    Raises InputError for a percentile outside [0, 100), edges not above 0 or budgets below 0.
    """
    for name, value in (("static_percentile", static_percentile), ("dynamic_percentile", dynamic_percentile)):
        if not 0 <= value < 100:
            raise InputError(f"{name} is {value!r}; expected at least 0 and less than 100")
    if edges is not None and not edges > 0:
        raise InputError(f"edges is {edges!r}; expected a share above 0, or None")
    most_static = whole_number("most_static", most_static, 0)
    most_moving = whole_number("most_moving", most_moving, 0)

    least = least_confidence(result, static_percentile, dynamic_percentile)
    count = len(result.depth)
    rank = np.random.default_rng(0).permutation(result.depth[0].size)  # of pixels: the lowest are kept
    middle, radius = middle_and_radius(result)
    thinning, moving = EvenThinning(most_static), []
    for number in range(count):
        frame = frame_of(result, number)
        pixels = frame.confident(least)
        if edges is not None:
            pixels &= ~on_edges(frame, edges)
        positions = frame.world_points().reshape(-1, 3)
        pixels &= np.isfinite(positions).all(axis=-1).reshape(pixels.shape)  # too far away for float32
        points = _points(positions, number, pixels & frame.dynamic_mask)
        if len(points.pixels) > most_moving:
            chosen = np.argsort(rank[points.pixels])[:most_moving]
            points = ShownPoints(*(field[np.sort(chosen)] for field in points))
        moving.append(points)
        points = _points(positions, number, pixels & ~frame.dynamic_mask)
        places = places_in_cube(points.positions.astype(np.float64), middle, radius)
        confidence = frame.confidence.ravel()[points.pixels]
        thinning.add(Candidates(points.positions, places, confidence, points.frames, points.pixels))
        (progress or no_progress)(number + 1, count)
    kept = thinning.kept()
    if kept is None:
        return ShownPoints(np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(0, np.int32)), moving
    return ShownPoints(kept.positions, kept.frames, kept.pixels), moving


def middle_and_radius(result: Result) -> tuple[Float64[np.ndarray, " 3"], float]:
    """Return the middle of the cameras, and a distance from it that reaches about half of the points of any camera.

    It is the median depth of the clip, plus the distance of the camera farthest from the middle.
    """
    centres = camera_centres(result.camera_from_world.astype(np.float64))  # squares of far places are finite
    middle = centres.mean(axis=0)
    chosen = np.linspace(0, len(centres) - 1, min(len(centres), 16)).round().astype(int)
    frames = [frame_of(result, int(number)) for number in chosen]
    depth = np.concatenate([frame.depth[frame.valid] for frame in frames])
    reach = float(np.median(depth.astype(np.float64))) if depth.size else 1.0
    return middle, reach + float(np.linalg.norm(centres - middle, axis=-1).max())


def relative_steps(frame: ResultFrame) -> Float32[np.ndarray, "h w"]:
    """Return the largest step of depth to a valid neighbour, over the smaller of both; 0 on slopes up to 83 degrees."""
    steps = np.zeros(frame.depth.shape, np.float32)
    for axis, (before, after) in enumerate(_NEIGHBOURS):
        one, other = frame.depth[before], frame.depth[after]
        with np.errstate(all="ignore"):
            step = np.where(frame.valid[before] & frame.valid[after], np.abs(one - other) / np.minimum(one, other), 0)
        slope = _STEEPEST / frame.intrinsics[1 - axis, 1 - axis]  # a pixel spans the angle 1 / focal length
        step[~(step > slope)] = 0
        np.maximum(steps[before], step, out=steps[before])
        np.maximum(steps[after], step, out=steps[after])
    return steps


def on_edges(frame: ResultFrame, edges: float) -> Bool[np.ndarray, "h w"]:
    """Return the pixels beside a step of depth, on both of its sides, and the static pixels beside moving ones."""
    found, moving = relative_steps(frame) > edges, frame.dynamic_mask
    for before, after in _NEIGHBOURS:
        found[before] |= moving[after] & ~moving[before]
        found[after] |= moving[before] & ~moving[after]
    return found


def _points(positions: Float32[np.ndarray, "P 3"], number: int, pixels: Bool[np.ndarray, "h w"]) -> ShownPoints:
    chosen = np.flatnonzero(pixels).astype(np.int32)
    return ShownPoints(positions[chosen], np.full(len(chosen), number, np.int32), chosen)
