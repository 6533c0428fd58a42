"""A result and its pictures on a grid of square cells, fine enough for matching and the same for all sizes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from vggtjax.cameras import Cameras
from vggtjax.errors import ClipError
from vggtjax.results.result import Result

Box = tuple[float, float, float, float]

CELLS = 24  # along a frame's longer side
_PIXELS = 12  # of a cell in the finest pictures that are matched
_ROUNDING = 1e-6  # pixels of the source


class Cells(NamedTuple):
    """What a result says at the centres of P cells, in rows."""

    grid: tuple[int, int]  # rows and columns
    depth: Float32[np.ndarray, "S P"]
    is_static: Float32[np.ndarray, "S P"]  # the share of a cell's pixels that show a point which does not move
    cameras: Cameras  # intrinsics in cells


def cells_of(result: Result) -> Cells:
    """Return the result at its cells. Frames without a known depth have the clip's median."""
    frames, height, width = result.depth.shape
    rows, columns = grid = grid_of((height, width))
    known = result.valid_pixels
    unit = np.median(result.depth[known]) if known.any() else 1.0
    logs = np.log(np.where(known, result.depth, unit), dtype=np.float32)
    row, column = (
        np.minimum((np.arange(n) + 0.5) * side / n, side - 1).astype(int)
        for n, side in zip(grid, (height, width), strict=True)
    )
    # The pixel of the centre, and those left and above it: their mean without the nearest and the furthest.
    four = np.stack([logs[:, np.maximum(row - i, 0)][:, :, np.maximum(column - j, 0)] for i in (0, 1) for j in (0, 1)])
    depth = np.exp(np.sort(four, axis=0)[1:3].mean(axis=0)).reshape(frames, -1)
    static = (known & ~result.dynamic_mask).astype(np.uint8) * 255
    shares = [np.asarray(Image.fromarray(each).resize((columns, rows), Image.Resampling.BOX)) for each in static]
    return Cells(grid, depth, np.stack(shares).reshape(frames, -1) / np.float32(255), cameras_in_cells(result, grid))


def cameras_in_cells(result: Result, grid: tuple[int, int]) -> Cameras:
    """Return the result's cameras with intrinsics in cells."""
    height, width = result.depth.shape[1:]
    scale = np.array([[grid[1] / width], [grid[0] / height], [1]], np.float32)
    return Cameras(result.camera_from_world, result.intrinsics * scale)


def grid_of(size: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of nearly square cells for frames of this height and width; at least two."""
    rows, columns = (max(2, round(CELLS * side / max(size))) for side in size)
    return rows, columns


def grey_pictures(
    result: Result, pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None, grid: tuple[int, int]
) -> UInt8[np.ndarray, "S H W"]:
    """Return grey pictures of what the result's frames show, with 12 pixels a cell; of its own images without others.

    Raises ClipError for a missing picture, or one of another size than the result's.
    """
    size = (grid[1] * _PIXELS, grid[0] * _PIXELS)
    if pictures is None:
        return np.stack([_grey(Image.fromarray(image), size) for image in result.images])
    made = []
    for frame, picture in zip(range(len(result.depth)), pictures, strict=False):
        check_size(result, frame, picture)
        image, box = _framed(result, frame, picture)
        made.append(_grey(image, size, box))
    check_number(result, len(made))
    return np.stack(made)


def at_scale(grey: UInt8[np.ndarray, "S H W"], grid: tuple[int, int], pixels: int) -> Float32[np.ndarray, "S h w"]:
    """Return pictures with so many pixels a cell, in [0, 1]."""
    size = (grid[1] * pixels, grid[0] * pixels)
    smaller = [Image.fromarray(each).resize(size, Image.Resampling.BICUBIC) for each in grey]
    return np.stack([np.asarray(each) for each in smaller]) / np.float32(255)


def check_size(result: Result, frame: int, picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Raise ClipError for a picture of another size than the result's source."""
    height, width = result.source_size[frame].tolist()
    if picture.shape[:2] != (height, width):
        size = "{1} x {0}".format(*picture.shape)
        raise ClipError(f"picture {frame} has {size} pixels; the result was made from {width} x {height}")


def check_number(result: Result, pictures: int) -> None:
    """Raise ClipError for fewer pictures than frames."""
    frames = len(result.depth)
    if pictures < frames:
        raise ClipError(f"the source gives {pictures} pictures of the {frames} frames; load the clip anew")


def _grey(picture: Image.Image, size: tuple[int, int], box: Box | None = None) -> UInt8[np.ndarray, "H W"]:
    return np.asarray(picture.convert("L").resize(size, Image.Resampling.BICUBIC, box=box))


def _framed(result: Result, frame: int, picture: UInt8[np.ndarray, "h w 3"]) -> tuple[Image.Image, Box]:
    """Return a picture that holds the whole frame, with grey where the frame is padded, and the frame's box in it."""
    height, width = result.depth.shape[1:]
    (right, down), (left, top) = result.source_scale[frame], result.source_offset[frame]
    box = np.array([left, top, left + right * width, top + down * height])
    image = Image.fromarray(picture)
    outside = np.array([-left, -top, box[2] - image.width, box[3] - image.height])
    if (outside > _ROUNDING).any():
        x, y, more_x, more_y = np.maximum(np.ceil(outside), 0).astype(int).tolist()
        whole = Image.new("RGB", (image.width + x + more_x, image.height + y + more_y), (128, 128, 128))
        whole.paste(image, (x, y))
        image, box = whole, np.add(box, [x, y, x, y])
    x0, y0, x1, y1 = np.clip(box, 0, [image.width, image.height] * 2).tolist()
    return image, (x0, y0, x1, y1)
