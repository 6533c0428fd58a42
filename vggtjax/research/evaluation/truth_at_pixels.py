"""The ground truth of a sequence at the pixels of a result. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from vggtjax.cameras import FEWEST_POSES, moves, unproject, world_from_camera
from vggtjax.clips.captures.capture import OtherShapeError
from vggtjax.clips.truth import Placed, at_clip_pixels, intrinsics_at_clip_pixels
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence, LeftOut, left_out

PIXEL_OFFSET = 0.0  # of points: the protocol lifts whole pixel numbers, predicted and true ones alike


class AbsentError(InputError):
    """The sequence or the result lacks an input of a protocol: its metrics are left out, and nothing has failed."""


class TruthAtPixels:
    """A sequence's ground truth at the pixels of results with one placement; each part is read at its first use.

    Depth beyond `max_depth` metres counts as unknown. A part that the sequence lacks raises AbsentError. Maps of
    another shape than their pictures are left out, which `left_out` says, unless `strict`.
    """

    def __init__(
        self, sequence: LabelledSequence, placed: Placed, *, max_depth: float | None = None, strict: bool = False
    ) -> None:
        self.sequence = sequence
        self.strict = strict
        self.left_out: dict[str, LeftOut] = {}
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
        sizes = [(int(height), int(width)) for height, width in self._placed.source_size]
        maps = self._read("depth", read)
        missing = [
            np.zeros(size, np.float32) if depth is None else depth for depth, size in zip(maps, sizes, strict=True)
        ]
        depth = _stacked("depth", [depth.astype(np.float32) for depth in missing])
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
    def masked(self) -> Bool[np.ndarray, " S"]:
        """Frames with a mask."""
        return np.array([mask is not None for mask in self._masks])

    @cached_property
    def mask(self) -> Bool[np.ndarray, "S H W"]:
        """True where the world moves, at the pixels of the result; empty in frames that are not `masked`."""
        known = next((mask for mask in self._masks if mask is not None), None)
        if known is None:
            raise AbsentError("no frame of the sequence has a mask of its picture's shape")
        nothing = np.zeros_like(known)
        masks = [nothing if mask is None else mask for mask in self._masks]
        return at_clip_pixels(self._placed, _stacked("masks", masks))

    @cached_property
    def _masks(self) -> list[Bool[np.ndarray, "h w"] | None]:
        if (read := self.sequence.mask) is None:
            raise AbsentError("the sequence has no masks")
        return self._read("masks", read)

    def _read(self, what: str, read: Callable[[int], np.ndarray | None]) -> list[np.ndarray | None]:
        """Return the maps of all frames; those of another shape than their pictures are left out, unless strict."""
        maps: list[np.ndarray | None] = []
        other: list[str] = []
        for frame, name in enumerate(self.sequence.frame_names):
            try:
                maps.append(read(frame))
            except OtherShapeError:
                if self.strict:
                    raise
                maps.append(None)
                other.append(name)
        for each in left_out(what, other, len(maps), f"have {what} of another shape than their picture"):
            self.left_out[what] = each
        return maps

    @property
    def posed(self) -> Bool[np.ndarray, " S"]:
        """Frames with a camera pose."""
        return self.sequence.posed

    @property
    def poses(self) -> Float64[np.ndarray, "P 4 4"]:
        """Cameras of the frames that are `posed`, world from camera."""
        poses = self.sequence.world_from_camera
        if poses is None:
            raise AbsentError("the sequence has no camera poses")
        poses = poses[self.posed]
        if len(poses) < FEWEST_POSES:
            raise AbsentError(f"there are {len(poses)} true cameras; an alignment needs {FEWEST_POSES}")
        if not moves(poses[:, :3, 3]):
            raise AbsentError(f"the {len(poses)} true cameras do not move; an alignment needs motion")
        return poses

    @property
    def shown(self) -> Bool[np.ndarray, "S H W"]:
        """Pixels with a true depth, in frames with a true camera."""
        return (self.depth > 0) & self.posed[:, None, None]

    @property
    def intrinsics(self) -> Float64[np.ndarray, "S 3 3"]:
        """Of the frames, in pixels of the result."""
        if self.sequence.intrinsics is None:
            raise AbsentError("the sequence has no intrinsics")
        return intrinsics_at_clip_pixels(self._placed, self.sequence.intrinsics)

    @cached_property
    def points(self) -> Float32[np.ndarray, "N 3"]:
        """Points in the true world of all pixels with a true depth, in frames with a true camera."""
        intrinsics = self.intrinsics
        poses = np.tile(np.eye(4), (len(self.sequence), 1, 1))
        poses[self.posed] = self.poses
        if not self.shown.any():
            raise AbsentError("no frame of the sequence has both a true depth and a true camera")
        return known_points(self.depth, intrinsics, world_from_camera(poses[:, :3])[:, :3], self.shown)


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
