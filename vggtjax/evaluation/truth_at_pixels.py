"""The ground truth of a sequence at the pixels of a result. Does not import jax."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from vggtjax.cameras import unproject, world_from_camera
from vggtjax.clips.truth import Placed, at_clip_pixels, intrinsics_at_clip_pixels
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.sequence import LabelledSequence
from vggtjax.geometry.similarity import FEWEST_POSES, moves

PIXEL_OFFSET = 0.0  # of points: the protocol lifts whole pixel numbers, predicted and true ones alike


class AbsentError(InputError):
    """The sequence or the result lacks an input of a protocol: its metrics are left out, and nothing has failed."""


class TruthAtPixels:
    """A sequence's ground truth at the pixels of results with one placement; each part is read at its first use.

    Depth beyond `max_depth` metres counts as unknown. A part that the sequence lacks raises AbsentError.
    """

    def __init__(self, sequence: LabelledSequence, placed: Placed, *, max_depth: float | None = None) -> None:
        self.sequence = sequence
        self.max_depth = max_depth
        self._placed = placed

    def fits(self, placed: Placed) -> bool:
        """Return whether another result has the same placement."""
        names = ("source_size", "source_scale", "source_offset", "valid_box")
        same = (np.array_equal(getattr(self._placed, name), getattr(placed, name)) for name in names)
        return self._placed.images.shape == placed.images.shape and all(same)

    @cached_property
    def depth_at_source(self) -> Float32[np.ndarray, "S h w"]:
        """Metres, 0 where unknown, at the size of the pictures."""
        if (read := self.sequence.depth) is None:
            raise AbsentError("the sequence has no depth")
        depth = _stacked("depth", [read(i).astype(np.float32) for i in range(len(self.sequence))])
        if self.max_depth is not None:
            depth[depth >= self.max_depth] = 0
        return depth

    @cached_property
    def depth(self) -> Float32[np.ndarray, "S H W"]:
        """Metres, 0 where unknown, at the pixels of the result: each takes the depth of the pixel around its centre."""
        depth = at_clip_pixels(self._placed, self.depth_at_source)
        if not (depth > 0).any():
            raise AbsentError("no pixel of the sequence has a true depth")
        return depth

    @cached_property
    def mask(self) -> Bool[np.ndarray, "S H W"]:
        """True where the world moves, at the pixels of the result."""
        if (read := self.sequence.mask) is None:
            raise AbsentError("the sequence has no masks")
        return at_clip_pixels(self._placed, _stacked("masks", [read(i) for i in range(len(self.sequence))]))

    @property
    def poses(self) -> Float64[np.ndarray, "S 4 4"]:
        """Cameras, world from camera."""
        poses = self.sequence.world_from_camera
        if poses is None:
            raise AbsentError("the sequence has no camera poses")
        if len(poses) < FEWEST_POSES:
            raise AbsentError(f"there are {len(poses)} true cameras; an alignment needs {FEWEST_POSES}")
        if not moves(poses[:, :3, 3]):
            raise AbsentError(f"the {len(poses)} true cameras do not move; an alignment needs motion")
        return poses

    @cached_property
    def points(self) -> Float32[np.ndarray, "N 3"]:
        """Points in the true world of all pixels with a true depth."""
        if self.sequence.intrinsics is None:
            raise AbsentError("the sequence has no intrinsics")
        intrinsics = intrinsics_at_clip_pixels(self._placed, self.sequence.intrinsics)
        camera_from_world = world_from_camera(self.poses[:, :3])[:, :3]
        return known_points(self.depth, intrinsics, camera_from_world, self.depth > 0)


def _stacked(what: str, maps: list[np.ndarray]) -> np.ndarray:
    sizes = {each.shape for each in maps}
    if len(sizes) > 1:
        raise InputError(f"{what} of the sequence have {len(sizes)} sizes, {sorted(sizes)[:3]}; expected one size")
    return np.stack(maps)


def known_points(
    depth: Float[np.ndarray, "S H W"],
    intrinsics: Float[np.ndarray, "S 3 3"],
    camera_from_world: Float[np.ndarray, "S 3 4"],
    known: Bool[np.ndarray, "S H W"],
) -> Float32[np.ndarray, "N 3"]:
    """Lift the known pixels to their points. One frame at a time is in float64."""
    points = np.empty((int(known.sum()), 3), np.float32)
    end = 0
    for index in range(len(depth)):
        frame = slice(index, index + 1)
        lifted = unproject(
            depth[frame].astype(np.float64), intrinsics[frame], camera_from_world[frame], pixel_offset=PIXEL_OFFSET
        )
        start, end = end, end + int(known[index].sum())
        points[start:end] = lifted[0][known[index]]
    return points
