"""Ground truth of a clip, and of its source at the pixels of the clip. Does not import jax."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Float64, Shaped

from vggtjax.errors import InputError


class ClipTruth(Protocol):
    """Clips with exact truth, [S, ...] or [B, S, ...] throughout; a generated scene is one, and so is `Truth`."""

    @property
    def images(self) -> Any: ...  # [*B, S, H, W, 3] RGB in [0, 1]

    @property
    def depth(self) -> Any: ...  # [*B, S, H, W] along z; not above 0 where it is not known

    @property
    def dynamic_mask(self) -> Any: ...  # [*B, S, H, W] bool

    @property
    def camera_from_world(self) -> Any: ...  # [*B, S, 3, 4] OpenCV

    @property
    def intrinsics(self) -> Any: ...  # [*B, S, 3, 3] pixels


class Truth(NamedTuple):
    """Clips with exact truth as arrays on the host; see `ClipTruth`."""

    images: np.ndarray
    depth: np.ndarray
    dynamic_mask: np.ndarray
    camera_from_world: np.ndarray
    intrinsics: np.ndarray

    def clip(self, number: int | np.ndarray) -> Truth:
        """Return one clip of a batch, or several."""
        return Truth(*(array[number] for array in self))


def batched_truth(truth: ClipTruth) -> Truth:
    """Return truth on the host with a batch axis. Raises InputError for shapes that do not fit together."""
    arrays = Truth(*(np.asarray(getattr(truth, name)) for name in Truth._fields))
    if arrays.images.ndim == 4:
        arrays = Truth(*(array[None] for array in arrays))
    shape = arrays.images.shape
    if len(shape) != 5 or shape[4] != 3 or not all(shape):
        raise InputError(f"images have shape {shape}; expected [S, H, W, 3] or [B, S, H, W, 3], none empty")
    B, S, H, W = shape[:4]
    expected = (shape, (B, S, H, W), (B, S, H, W), (B, S, 3, 4), (B, S, 3, 3))
    for name, array, wanted in zip(Truth._fields, arrays, expected, strict=True):
        if array.shape != wanted:
            raise InputError(f"{name} has shape {array.shape}; expected {wanted} beside images of shape {shape}")
    if arrays.dynamic_mask.dtype != bool:
        raise InputError(f"dynamic_mask has type {arrays.dynamic_mask.dtype}; expected bool")
    return arrays


class Placed(Protocol):
    """Frames with their place in the source's pictures: a `Clip` is one, and a `Reconstruction`."""

    @property
    def images(self) -> np.ndarray: ...  # [S, H, W, 3]

    @property
    def source_size(self) -> np.ndarray: ...  # [S, 2], height and width

    @property
    def source_scale(self) -> np.ndarray: ...  # [S, 2], source (x, y) = scale * (x, y) + offset

    @property
    def source_offset(self) -> np.ndarray: ...  # [S, 2]

    @property
    def valid_box(self) -> np.ndarray: ...  # [S, 4], left, top, right, bottom


def at_clip_pixels(clip: Placed, maps: Shaped[np.ndarray, "S h w"]) -> Shaped[np.ndarray, "S H W"]:
    """Return maps of the source's frames at the pixels of the clip, through the very resize and crop of its images.

    Each clip pixel takes the value of the source pixel in which its centre lies: depth is never averaged across an
    edge, nor with pixels that were not measured. Padding gets 0 (False).

    Raises InputError for maps that are not of the source's size, frame by frame.
    """
    maps = np.asarray(maps)
    sizes = {(int(height), int(width)) for height, width in clip.source_size}
    frames, height, width = clip.images.shape[:3]
    if sizes != {maps.shape[1:]} or len(maps) != frames:
        raise InputError(
            f"maps have shape {maps.shape}; expected {frames} of the source's size {' and '.join(map(str, sizes))}"
        )
    result = np.zeros((frames, height, width), maps.dtype)
    for frame, (left, top, right, bottom) in enumerate(clip.valid_box):
        pixels = np.stack(np.meshgrid(np.arange(left, right), np.arange(top, bottom)), axis=-1)
        places = (pixels + 0.5) * clip.source_scale[frame] + clip.source_offset[frame]
        x, y = np.moveaxis(np.floor(places).astype(int), -1, 0)
        result[frame, top:bottom, left:right] = maps[frame, y, x]
    return result


def intrinsics_at_clip_pixels(
    clip: Placed, intrinsics: Float[np.ndarray, "3 3"] | Float[np.ndarray, "S 3 3"]
) -> Float64[np.ndarray, "S 3 3"]:
    """Return intrinsics of the source's pixels in pixels of the clip: focal lengths, skew and principal point.

    Both count from the outer corner of the first pixel, whose centre is (0.5, 0.5).
    """
    wanted = (len(clip.images), 3, 3)
    intrinsics = np.asarray(intrinsics, np.float64)
    if intrinsics.shape not in (wanted, wanted[1:]):
        raise InputError(f"intrinsics have shape {intrinsics.shape}; expected {wanted} or {wanted[1:]}")
    result = np.broadcast_to(intrinsics, wanted).copy()
    result[:, :2, 2] -= clip.source_offset
    result[:, :2] /= clip.source_scale[:, :, None]
    return result
