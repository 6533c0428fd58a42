"""One frame of a result, at the model's size or at that of the picture it came from: crop, scale, padding undone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8
from PIL import Image

from vggtjax import cameras as geometry
from vggtjax.errors import InputError
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.saving import Resolution

SAME_SURFACE = 0.05  # relative difference in depth up to which neighbours are taken for one surface


class Frame(NamedTuple):
    """What a frame of h x w pixels shows."""

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]  # z in the camera; 0 where not seen, at the source's size
    confidence: Float32[np.ndarray, "h w"]  # 0 there
    dynamic_mask: Bool[np.ndarray, "h w"]  # False there
    instances: UInt8[np.ndarray, "h w"]  # 0 there
    seen: Bool[np.ndarray, "h w"]  # by the model: neither padding nor cut off
    intrinsics: Float64[np.ndarray, "3 3"]  # pixels of h x w
    camera_from_world: Float32[np.ndarray, "3 4"]

    @property
    def valid(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show a point: seen, with a finite depth above 0 and a finite confidence."""
        return self.seen & np.isfinite(self.depth) & (self.depth > 0) & np.isfinite(self.confidence)

    def surer_than(self, least_confidence: float) -> Bool[np.ndarray, "h w"]:
        """Valid pixels of at least this confidence."""
        return self.valid & (self.confidence >= least_confidence)

    def world_points(self, *, pixel_offset: float = 0.5) -> Float32[np.ndarray, "h w 3"]:
        """Lift every pixel to its point in the world; those of depth 0 are at the camera's centre."""
        intrinsics = self.intrinsics[None].astype(np.float32)
        points = geometry.unproject(
            self.depth[None], intrinsics, self.camera_from_world[None], pixel_offset=pixel_offset
        )
        return points[0]


def frame_of(
    result: Reconstruction,
    frame: int,
    resolution: Resolution = "model",
    *,
    picture: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Frame:
    """Return a frame at the model's size, or at its source's.

    At the source's size every pixel takes the place that its centre has in the model's frame. Masks and confidence are
    those of the nearest pixel. Depth is bilinear in the inverse where the four pixels around belong to one surface, and
    that of the nearest one elsewhere: bilinear everywhere invents points between object and background.

    Args:
        result: of a clip.
        frame: its index.
        resolution: "model" or "original".
        picture: the source's, for "original"; without it the model's frame is enlarged, and black where that was cut.

    Raises:
        InputError: a frame that is not there, an unknown resolution, or a picture of another size than the source's.
    """
    if not 0 <= frame < len(result.depth):
        raise InputError(f"frame is {frame}; expected 0 to {len(result.depth) - 1}")
    if resolution not in ("model", "original"):
        raise InputError(f"resolution is {resolution!r}; expected 'model' or 'original'")
    return _model_frame(result, frame) if resolution == "model" else _source_frame(result, frame, picture)


def inside_pictures(result: Reconstruction) -> Bool[np.ndarray, "S H W"]:
    """Return the pixels that are not padding."""
    return _inside(result.valid_box, result.depth.shape[1:])


def valid_pixels(result: Reconstruction) -> Bool[np.ndarray, "S H W"]:
    """Return the pixels that show a point: not padding, with a finite depth above 0 and a finite confidence."""
    depth = result.depth
    return inside_pictures(result) & np.isfinite(depth) & (depth > 0) & np.isfinite(result.depth_confidence)


def _inside(box: Int[np.ndarray, "... 4"], size: tuple[int, ...]) -> Bool[np.ndarray, "... H W"]:
    rows, columns = np.arange(size[0])[:, None], np.arange(size[1])
    left, top, right, bottom = np.moveaxis(box, -1, 0)[..., None, None]
    return (left <= columns) & (columns < right) & (top <= rows) & (rows < bottom)


def _model_frame(result: Reconstruction, frame: int) -> Frame:
    return Frame(
        image=result.images[frame],
        depth=result.depth[frame],
        confidence=result.depth_confidence[frame],
        dynamic_mask=result.dynamic_mask[frame],
        instances=result.instances[frame],
        seen=_inside(result.valid_box[frame], result.depth.shape[1:]),
        intrinsics=result.intrinsics[frame].astype(np.float64),
        camera_from_world=result.camera_from_world[frame],
    )


def _source_frame(result: Reconstruction, frame: int, picture: UInt8[np.ndarray, "h w 3"] | None) -> Frame:
    height, width = (int(side) for side in result.source_size[frame])
    scale, offset = result.source_scale[frame], result.source_offset[frame]
    if picture is None:
        (a, e), (c, f) = 1 / scale, -offset / scale
        small = Image.fromarray(result.images[frame])
        large = small.transform((width, height), Image.Transform.AFFINE, (a, 0, c, 0, e, f), Image.Resampling.BICUBIC)
        picture = np.asarray(large)
    kind, shape = getattr(picture, "dtype", type(picture).__name__), getattr(picture, "shape", None)
    if shape != (height, width, 3) or kind != np.uint8:
        raise InputError(f"the picture of frame {frame} is {kind} {shape}; expected uint8 {(height, width, 3)}")
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
    return Frame(
        image=picture,
        depth=np.where(seen, depth, 0).astype(np.float32),
        confidence=np.where(seen, result.depth_confidence[frame][nearest], 0).astype(np.float32),
        dynamic_mask=result.dynamic_mask[frame][nearest] & seen,
        instances=np.where(seen, result.instances[frame][nearest], 0).astype(np.uint8),
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
