"""A result and its pictures on a grid of square cells, fine enough for matching and the same for all sizes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int, UInt8
from PIL import Image

from vggtjax.cameras import Cameras
from vggtjax.errors import ClipError
from vggtjax.results.result import Result

Box = tuple[float, float, float, float]

CELLS = 24  # along a frame's longer side
_PIXELS = 12  # of a cell in the finest pictures that are matched
_ROUNDING = 1e-6  # pixels of the source
_FARTHEST = 1e4  # of the median depth, and its inverse: the others have no parallax, or are noise


class Cells(NamedTuple):
    """What a result says at the centres of P cells, in rows."""

    grid: tuple[int, int]  # rows and columns
    depth: Float32[np.ndarray, "S P"]
    is_static: Float32[np.ndarray, "S P"]  # the share of a cell's pixels that show a point which does not move
    cameras: Cameras  # intrinsics in cells
    shown: Float32[np.ndarray, "S 4"]  # left, top, right, bottom of the picture in its padding, in cells; else infinite


def cells_of(result: Result) -> Cells:
    """Return the result at its cells. Frames without a known depth have the clip's median."""
    frames, height, width = result.depth.shape
    rows, columns = grid = grid_of((height, width))
    known = result.valid_pixels
    unit = np.median(result.depth[known]) if known.any() else 1.0
    logs = np.log(np.clip(np.where(known, result.depth, unit), unit / _FARTHEST, unit * _FARTHEST), dtype=np.float32)
    # Of the four pixels around a centre, bilinear; the nearest and the furthest count as the two between them.
    (row, down), (column, right) = (_around(n, side) for n, side in zip(grid, (height, width), strict=True))
    last = height - 1, width - 1
    four = np.stack(
        [logs[:, np.minimum(row + i, last[0])][:, :, np.minimum(column + j, last[1])] for i in (0, 1) for j in (0, 1)]
    )
    low, high = np.sort(four, axis=0)[1:3]
    down, right = down[:, None], right[None]
    shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
    depth = np.exp((shares[:, None] * np.clip(four, low, high)).sum(axis=0)).astype(np.float32).reshape(frames, -1)
    static = (known & ~result.dynamic_mask).astype(np.uint8) * 255
    shares = [np.asarray(Image.fromarray(each).resize((columns, rows), Image.Resampling.BOX)) for each in static]
    static_shares = np.stack(shares).reshape(frames, -1) / np.float32(255)
    return Cells(grid, depth, static_shares, cameras_in_cells(result, grid), _shown(result, grid))


def _shown(result: Result, grid: tuple[int, int]) -> Float32[np.ndarray, "S 4"]:
    """Return left, top, right and bottom of the pictures within their padding, in cells; infinite without padding."""
    height, width = result.depth.shape[1:]
    ends = np.array([0, 0, width, height])
    box = np.where(result.valid_box == ends, np.array([-np.inf, -np.inf, np.inf, np.inf]), result.valid_box)
    return (box * np.tile([grid[1] / width, grid[0] / height], 2)).astype(np.float32)


def _around(cells: int, side: int) -> tuple[Int[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
    """Return the first of the two pixels around each cell's centre, along a side, and the share of the second."""
    place = np.clip((np.arange(cells) + 0.5) * side / cells - 0.5, 0, side - 1)
    first = np.floor(place).astype(int)
    return first, (place - first).astype(np.float32)


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
