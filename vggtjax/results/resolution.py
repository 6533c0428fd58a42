"""A result at the size of the pictures it came from: crop, scale and padding undone, frame by frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from vggtjax.errors import InputError
from vggtjax.results import geometry
from vggtjax.results.reconstruction import Reconstruction

SAME_SURFACE = 0.05  # relative difference in depth up to which neighbours are taken for one surface


class SourceFrame(NamedTuple):
    """One frame at the size h x w of its source picture; what was cut off has no depth."""

    depth: Float32[np.ndarray, "h w"]  # 0 where the model saw nothing
    confidence: Float32[np.ndarray, "h w"]  # 0 there
    dynamic_mask: Bool[np.ndarray, "h w"]  # False there
    seen: Bool[np.ndarray, "h w"]
    intrinsics: Float64[np.ndarray, "3 3"]  # pixels of h x w
    camera_from_world: Float32[np.ndarray, "3 4"]

    def world_points(self, *, pixel_offset: float = 0.5) -> Float32[np.ndarray, "h w 3"]:
        """Lift every pixel to its point in the world; those that were not seen are at the camera's centre."""
        intrinsics = self.intrinsics[None].astype(np.float32)
        points = geometry.unproject(
            self.depth[None], intrinsics, self.camera_from_world[None], pixel_offset=pixel_offset
        )
        return points[0]


def source_frame(result: Reconstruction, frame: int) -> SourceFrame:
    """Return a frame at its source's size.

    Every source pixel takes the place that its centre has in the model's frame. Masks and confidence are those of the
    nearest pixel. Depth is bilinear in the inverse where the four pixels around belong to one surface, and that of the
    nearest one elsewhere: bilinear everywhere invents points between object and background.

    Raises InputError for a frame that is not there.
    """
    if not 0 <= frame < len(result.depth):
        raise InputError(f"frame is {frame}; expected 0 to {len(result.depth) - 1}")
    height, width = (int(side) for side in result.source_size[frame])
    scale, offset = result.source_scale[frame], result.source_offset[frame]
    x = (np.arange(width) + 0.5 - offset[0]) / scale[0]
    y = (np.arange(height) + 0.5 - offset[1]) / scale[1]
    left, top, right, bottom = (int(side) for side in result.valid_box[frame])
    seen = ((y >= top) & (y <= bottom))[:, None] & ((x >= left) & (x <= right))[None]
    column = np.clip(np.floor(x).astype(int), left, right - 1)
    row = np.clip(np.floor(y).astype(int), top, bottom - 1)
    nearest = np.ix_(row, column)
    depth = enlarged_depth(result.depth[frame, top:bottom, left:right], x - left, y - top)
    intrinsics = result.intrinsics[frame].astype(np.float64)
    intrinsics[:2] *= scale[:, None]
    intrinsics[:2, 2] += offset
    return SourceFrame(
        depth=np.where(seen, depth, 0).astype(np.float32),
        confidence=np.where(seen, result.depth_confidence[frame][nearest], 0).astype(np.float32),
        dynamic_mask=result.dynamic_mask[frame][nearest] & seen,
        seen=seen,
        intrinsics=intrinsics,
        camera_from_world=result.camera_from_world[frame],
    )


def enlarged_depth(
    depth: Float[np.ndarray, "H W"], x: Float[np.ndarray, " w"], y: Float[np.ndarray, " h"]
) -> Float[np.ndarray, "h w"]:
    """Sample depth at rows y and columns x (pixel edges at whole numbers), without mixing surfaces.

    Depth that is not a positive number is nobody's surface: there the nearest pixel stands alone.
    """
    H, W = depth.shape
    (low_x, high_x, share_x), (low_y, high_y, share_y) = (
        _between(position, side) for position, side in ((x, W), (y, H))
    )
    corners = np.stack([depth[np.ix_(a, b)] for a in (low_y, high_y) for b in (low_x, high_x)])
    weights = np.stack([a[:, None] * b[None] for a in (1 - share_y, share_y) for b in (1 - share_x, share_x)])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mixed = 1 / (weights / corners).sum(axis=0)
        low, high = corners.min(axis=0), corners.max(axis=0)
        one_surface = (low > 0) & (high <= (1 + SAME_SURFACE) * low) & np.isfinite(high)
    nearest = depth[np.ix_(_nearest(y, H), _nearest(x, W))]
    return np.where(one_surface, mixed, nearest)


def _nearest(position: Float[np.ndarray, " n"], side: int) -> np.ndarray:
    return np.clip(np.floor(position).astype(int), 0, side - 1)


def _between(position: Float[np.ndarray, " n"], side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels whose centres lie at or below and above each position, and the share of the one above."""
    centred = np.clip(position - 0.5, 0, side - 1)
    low = np.floor(centred).astype(int)
    return low, np.minimum(low + 1, side - 1), centred - low
