"""One frame of a result, at the model's size or at its source's, where crop, scale and padding are undone."""

from __future__ import annotations

from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from PIL import Image

from vggtjax.cameras import unproject
from vggtjax.errors import InputError, check_choice
from vggtjax.results.result import Result
from vggtjax.results.saving import Resolution
from vggtjax.results.visible import inside_box, show_points

PLAIN_RATE = 10.0  # frames a second of clips without times
SAME_SURFACE = 0.05  # relative difference in depth up to which neighbours belong to one surface


class LeastConfidence(NamedTuple):
    """The least confidence of the points of a cloud, for static and for dynamic pixels."""

    static: float
    dynamic: float


class ResultFrame(NamedTuple):
    """A frame of h x w pixels."""

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]  # z in the camera; 0 where not seen at the source's size
    confidence: Float32[np.ndarray, "h w"]  # 0 where not seen
    dynamic_mask: Bool[np.ndarray, "h w"]  # False where not seen
    instances: UInt8[np.ndarray, "h w"]  # 0 where not seen
    seen: Bool[np.ndarray, "h w"]  # by the model: neither padding nor cut off
    intrinsics: Float64[np.ndarray, "3 3"]  # pixels of h x w
    camera_from_world: Float32[np.ndarray, "3 4"]

    @property
    def valid(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show a point: seen, with a finite depth above 0 and a finite confidence."""
        return show_points(self.depth, self.confidence, self.seen)

    def confident(self, least: LeastConfidence) -> Bool[np.ndarray, "h w"]:
        """Return the valid pixels of at least this confidence."""
        return self.valid & (self.confidence >= np.where(self.dynamic_mask, least.dynamic, least.static))

    def world_points(self, *, pixel_offset: float = 0.5) -> Float32[np.ndarray, "h w 3"]:
        """Lift every pixel to its point in the world; those of depth 0 are at the camera's centre."""
        intrinsics = self.intrinsics[None].astype(np.float32)
        return unproject(self.depth[None], intrinsics, self.camera_from_world[None], pixel_offset=pixel_offset)[0]


def frame_of(
    result: Result, frame: int, resolution: Resolution = "model", *, picture: UInt8[np.ndarray, "h w 3"] | None = None
) -> ResultFrame:
    """Return a frame at the model's size, or at its source's.

    At the source's size the centre of every pixel is mapped to the model's frame. Masks and confidence are those of the
    nearest pixel. Depth is bilinear in the inverse where the four nearest pixels belong to one surface, and that of the
    nearest pixel elsewhere: bilinear depth everywhere invents points between object and background.

    Args:
        result: of a clip.
        frame: its index.
        resolution: "model" or "original".
        picture: the source's, for "original"; by default the model's frame enlarged, and black where it was cut off.

    Raises InputError for a frame out of range, an unknown resolution, or a picture of another size than the source's.
    """
    if not 0 <= frame < len(result.depth):
        raise InputError(f"frame is {frame}; expected 0 to {len(result.depth) - 1}")
    check_choice("resolution", resolution, get_args(Resolution))
    if resolution == "original":
        return _source_frame(result, frame, picture)
    return ResultFrame(
        image=result.images[frame],
        depth=result.depth[frame],
        confidence=result.depth_confidence[frame],
        dynamic_mask=result.dynamic_mask[frame],
        instances=result.instances[frame],
        seen=inside_box(result.valid_box[frame], result.depth.shape[1:]),
        intrinsics=result.intrinsics[frame].astype(np.float64),
        camera_from_world=result.camera_from_world[frame],
    )


def _source_frame(result: Result, frame: int, picture: UInt8[np.ndarray, "h w 3"] | None) -> ResultFrame:
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
    x, y, seen = source_pixels(result, frame)
    left, top, right, bottom = (int(side) for side in result.valid_box[frame])
    nearest = np.ix_(top + _nearest(y - top, bottom - top), left + _nearest(x - left, right - left))
    depth = enlarged_depth(result.depth[frame, top:bottom, left:right], x - left, y - top)
    intrinsics = result.intrinsics[frame].astype(np.float64)
    intrinsics[:2] *= scale[:, None]
    intrinsics[:2, 2] += offset
    return ResultFrame(
        image=picture,
        depth=np.where(seen, depth, 0).astype(np.float32),
        confidence=np.where(seen, result.depth_confidence[frame][nearest], 0).astype(np.float32),
        dynamic_mask=result.dynamic_mask[frame][nearest] & seen,
        instances=np.where(seen, result.instances[frame][nearest], 0).astype(np.uint8),
        seen=seen,
        intrinsics=intrinsics,
        camera_from_world=result.camera_from_world[frame],
    )


def source_pixels(
    result: Result, frame: int
) -> tuple[Float64[np.ndarray, " w"], Float64[np.ndarray, " h"], Bool[np.ndarray, "h w"]]:
    """Return where the pixels of a frame's source lie in the frame (x, y; edges at whole numbers), and which are seen.

    Cut off pixels lie outside the valid box and are not seen.
    """
    height, width = result.source_size[frame]
    scale, offset = result.source_scale[frame], result.source_offset[frame]
    x = (np.arange(width) + 0.5 - offset[0]) / scale[0]
    y = (np.arange(height) + 0.5 - offset[1]) / scale[1]
    left, top, right, bottom = result.valid_box[frame]
    return x, y, ((y >= top) & (y <= bottom))[:, None] & ((x >= left) & (x <= right))[None]


def enlarged_depth(
    depth: Float[np.ndarray, "H W"], x: Float[np.ndarray, " w"], y: Float[np.ndarray, " h"]
) -> Float[np.ndarray, "h w"]:
    """Sample depth at rows y and columns x (pixel edges at whole numbers), without mixing surfaces.

    Depth that is not a positive number belongs to no surface: it is never mixed.
    """
    H, W = depth.shape
    (low_x, high_x, share_x), (low_y, high_y, share_y) = _between(x, W), _between(y, H)
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
    """Return the pixels with centres at or below and above each position, and the share of the pixel above."""
    centred = np.clip(position - 0.5, 0, side - 1)
    low = np.floor(centred).astype(int)
    return low, np.minimum(low + 1, side - 1), centred - low
