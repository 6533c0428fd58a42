"""A volume of signed distances to the static surfaces of a result, fused over all frames by their precision.

Curless and Levoy 1996, "A volumetric method for building complex models from range images": a frame says how far a
place lies before the surface that its camera sees there, or behind it up to a reach. The weighted means of what all
frames say are 0 on the fused surface. The weights are the result's confidence, which is a precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy import ndimage
from scipy.spatial import KDTree

from vggtjax.cameras import project
from vggtjax.errors import InputError
from vggtjax.progress import Progress, no_progress
from vggtjax.results.frame import SAME_SURFACE, LeastConfidence, frame_of
from vggtjax.results.point_cloud import least_confidence
from vggtjax.results.result import Result
from vggtjax.results.shown import middle_and_radius, on_edges

MOST_VOXELS = 1 << 26  # of the box
_CHUNK = 1 << 17  # places at once, so that their arrays stay in a core's caches
PASSES = 4  # over the frames: grid, voxels near surfaces, distances, colours
_COMPARED = 16  # frames, each with each
_SAMPLES = 2000  # pixels of a frame by which the grid is laid out
_OUTLIERS = 1.0  # percent of the points on each side of an axis that do not widen the box
_MARGIN = 0.1  # of the box
_REACH_VOXELS, _REACH_SPREADS = 3.0, 3.0  # of the reach: voxels, and median differences between frames
_SAME_PLACE = 0.1  # of the scene's distance: frames whose depths differ by less are taken to see one surface


def _weights(confidence: Float32[np.ndarray, "H W"], unit: float) -> Float32[np.ndarray, "H W"]:
    """Return weights whose sums over frames stay finite and above 0; of a confidence its ratio to `unit` counts."""
    return np.clip(np.nan_to_num(confidence / np.float32(unit if unit > 0 else 1)), 1e-6, 1e12).astype(np.float32)


class Readings(NamedTuple):
    """What a frame says of those places that it sees."""

    places: Int64[np.ndarray, " K"]  # their indices
    before: Float32[np.ndarray, " K"]  # how far they lie before the surface, along the camera's axis
    weight: Float32[np.ndarray, " K"]
    color: Float32[np.ndarray, "K 3"]  # sRGB, 0 to 255; empty where not asked for


class StaticFrame:
    """The static surfaces of a frame: its confident, static pixels off the edges."""

    def __init__(self, result: Result, number: int, least: LeastConfidence) -> None:
        self._frame = frame = frame_of(result, number)
        self.usable: Bool[np.ndarray, "H W"] = (
            frame.confident(least) & ~frame.dynamic_mask & ~on_edges(frame, SAME_SURFACE)
        )
        self.usable &= np.isfinite(frame.world_points()).all(axis=-1)  # too far away for float32
        with np.errstate(divide="ignore", over="ignore"):
            self._disparity = np.where(self.usable, 1 / frame.depth, 0).astype(np.float32)
        self._weight = _weights(frame.confidence, least.static).ravel()
        whole = np.zeros_like(self.usable)  # the pixel and those to its right and below it
        usable = self.usable
        whole[:-1, :-1] = usable[:-1, :-1] & usable[1:, :-1] & usable[:-1, 1:] & usable[1:, 1:]
        self._whole = whole.ravel()

    def points(self) -> Float32[np.ndarray, "N 3"]:
        """Return the points of the usable pixels."""
        return self._frame.world_points()[self.usable]

    def footprints(self) -> Float32[np.ndarray, " N"]:
        """Return how wide each usable pixel is on a surface that faces the camera."""
        return self._frame.depth[self.usable] / np.float32(self._frame.intrinsics[[0, 1], [0, 1]].mean())

    def read(self, points: Float32[np.ndarray, "N 3"], *, color: bool = False) -> Readings:
        """Read the surface where points fall between four usable pixels; inverse depth is linear on a plane."""
        H, W = self.usable.shape
        with np.errstate(all="ignore"):
            x, y, z = project(points, self._frame.camera_from_world, self._frame.intrinsics)
        x, y = x - np.float32(0.5), y - np.float32(0.5)
        (places,) = np.nonzero((z > 0) & (x >= 0) & (y >= 0) & (x < W - 1) & (y < H - 1))
        x, y = x[places], y[places]
        column, row = x.astype(np.int64), y.astype(np.int64)
        corner = row * W + column
        kept = self._whole[corner]
        right, down, corner, places = (x - column)[kept], (y - row)[kept], corner[kept], places[kept]
        corners = [corner, corner + 1, corner + W, corner + W + 1]
        shares = [(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down]

        def between(values: np.ndarray) -> np.ndarray:
            mixed = [
                values[index] * share.reshape(-1, *[1] * (values.ndim - 1))
                for index, share in zip(corners, shares, strict=True)
            ]
            return (mixed[0] + mixed[1]) + (mixed[2] + mixed[3])

        with np.errstate(divide="ignore", over="ignore"):
            before = 1 / between(self._disparity.ravel()) - z[places]
        weight = between(self._weight)
        colors = between(self._frame.image.reshape(-1, 3)) if color else np.zeros((0, 3), np.float32)
        return Readings(places, before, weight, colors)


class Grid(NamedTuple):
    """A box of voxels; the centre of voxel i is `low + voxel * i`."""

    low: Float64[np.ndarray, " 3"]
    shape: tuple[int, int, int]
    voxel: float  # edge, in units of the result
    reach: float  # behind a surface, and before it, that its frame speaks of

    def points(self, indices: Int64[np.ndarray, " N"]) -> Float32[np.ndarray, "N 3"]:
        """Return the centres of voxels, given by their flat indices."""
        steps = np.stack(np.unravel_index(indices, self.shape), axis=-1)
        return (self.low + self.voxel * steps).astype(np.float32)


class StaticSurfaces:
    """The static surfaces of all frames of a result, each of which is made anew whenever it is read."""

    def __init__(self, result: Result, confidence_percentile: float, progress: Progress | None = None) -> None:
        """Take a result without its least confident pixels; `progress` is told of frames, each read `PASSES` times."""
        self._result, self._least = result, least_confidence(result, confidence_percentile)
        self._progress, self._read = progress or no_progress, 0

    def _frames(self) -> Iterator[StaticFrame]:
        count = len(self._result.depth)
        for number in range(count):
            yield StaticFrame(self._result, number, self._least)
            self._read += 1
            self._progress(self._read, PASSES * count)

    def grid(self, voxel_size: float | None) -> Grid:
        """Lay out the voxels: by default as wide as a pixel on the surfaces, or wider where frames differ by more.

        Raises InputError where nothing static is seen, and where `voxel_size` needs more than `MOST_VOXELS` voxels.
        """
        random = np.random.default_rng(0)
        points, footprints = [], []
        for frame in self._frames():
            chosen = random.permutation(int(frame.usable.sum()))[:_SAMPLES]
            points.append(frame.points()[chosen])
            footprints.append(frame.footprints()[chosen])
        if not sum(map(len, points)):
            raise InputError("no pixel is static, confident and off the edges; there is no surface to make a mesh of")
        low, high = np.percentile(np.concatenate(points).astype(np.float64), [_OUTLIERS, 100 - _OUTLIERS], axis=0)
        low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
        footprint, spread = float(np.median(np.concatenate(footprints))), self._spread(points)

        def reach(voxel: float) -> float:
            return max(_REACH_VOXELS * voxel, _REACH_SPREADS * spread)

        def sides(voxel: float) -> Float64[np.ndarray, " 3"]:
            return np.ceil((high - low + 2 * reach(voxel)) / voxel) + 1

        voxel = max(footprint, spread / 2) if voxel_size is None else voxel_size
        room = voxel
        with np.errstate(over="ignore"):
            while sides(room).prod() > MOST_VOXELS:
                room *= 1.02
        if voxel_size is not None and room > voxel:
            needed = " x ".join(f"{side:.6g}" for side in sides(voxel))
            digit = 10.0 ** (np.floor(np.log10(room)) - 2)
            raise InputError(
                f"voxels of {voxel:g} need {needed} of them, more than {MOST_VOXELS} in all; "
                f"the smallest that fit are {np.ceil(room / digit) * digit:.3g}"
            )
        width, height, depth = sides(room).astype(int).tolist()
        return Grid(low - reach(room), (width, height, depth), room, reach(room))

    def distances(self, grid: Grid) -> tuple[Float32[np.ndarray, "X Y Z"], Bool[np.ndarray, "X Y Z"]]:
        """Return signed distances, above 0 before the surfaces, and where they are known."""
        near = self._near(grid)
        total, weight = (np.zeros(len(near), np.float32) for _ in range(2))
        for frame in self._frames():
            for start in range(0, len(near), _CHUNK):
                read = frame.read(grid.points(near[start : start + _CHUNK]))
                counts = read.before > -grid.reach
                places, weights = start + read.places[counts], read.weight[counts]
                total[places] += weights * np.minimum(read.before[counts], np.float32(grid.reach))
                weight[places] += weights
        distance = np.full(grid.shape, grid.reach, np.float32)
        known = np.zeros(grid.shape, bool)
        found = weight > 0
        distance.ravel()[near[found]] = total[found] / weight[found]
        known.ravel()[near[found]] = True
        return distance, known

    def colors(self, points: Float32[np.ndarray, "N 3"], reach: float) -> Float32[np.ndarray, "N 3"]:
        """Return the mean colours, 0 to 255, of the frames that see points of the surfaces; 0 where none does.

        Frames whose own surface is nearer to a point count more.
        """
        total, weight = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        for frame in self._frames():
            for start in range(0, len(points), _CHUNK):
                read = frame.read(points[start : start + _CHUNK], color=True)
                weights = read.weight * np.maximum(1 - np.abs(read.before) / np.float32(reach), np.float32(1e-3))
                weight[start + read.places] += weights
                total[start + read.places] += weights[:, None] * read.color
        colors = total / np.maximum(weight, np.finfo(np.float32).tiny)[:, None]
        seen = weight > 0
        if seen.any() and not seen.all():
            colors[~seen] = colors[seen][KDTree(points[seen]).query(points[~seen])[1]]
        return colors

    def _near(self, grid: Grid) -> Int64[np.ndarray, " M"]:
        """Return the flat indices of the voxels within reach of a point, by blocks: all others stay unknown."""
        near = np.zeros(grid.shape, bool)
        for frame in self._frames():
            steps = np.rint((frame.points() - grid.low) / grid.voxel)
            steps = steps[((steps >= 0) & (steps < grid.shape)).all(axis=1)].astype(np.int64)
            near[tuple(steps.T)] = True
        width = 2 * int(np.ceil(grid.reach / grid.voxel)) + 1
        return np.flatnonzero(ndimage.maximum_filter(near, width))

    def _spread(self, points: list[Float32[np.ndarray, "N 3"]]) -> float:
        """Return the median difference of depth between frames that see one place; 0 for a single frame."""
        largest = _SAME_PLACE * middle_and_radius(self._result)[1]
        chosen = np.unique(np.linspace(0, len(points) - 1, _COMPARED).round().astype(int))
        found = [np.zeros(0, np.float32)]
        for number in chosen:
            frame = StaticFrame(self._result, number, self._least)
            apart = (np.abs(frame.read(points[other]).before) for other in chosen if other != number)
            found += [some[some < largest] for some in apart]
        differences = np.concatenate(found)
        return float(np.median(differences)) if len(differences) else 0.0
