"""Coloured points seen by a pinhole camera: discs with a depth test, drawn by numpy.

The nearest point centred in each pixel is written into a picture of ranks, a picture for each radius; a maximum over
the disc around each pixel spreads it. That is the depth test of all discs, at a cost that does not grow with their size
in points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, Int32, UInt8

from vggtjax.cameras import Cameras, project
from vggtjax.errors import InputError, whole_number

BACKGROUND = (20, 20, 24)
_RADII = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 22, 28])  # drawn pixels; each one takes a picture of ranks
_MOST_PIXELS = 1 << 26  # drawn; two pictures of ranks take 0.5 GB


class Splats(NamedTuple):
    """Points in the world, as discs that face the camera."""

    positions: Float32[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    diameters: Float32[np.ndarray, " N"]  # in the world

    @staticmethod
    def joined(*parts: Splats) -> Splats:
        """Return the discs of all parts, one after the other."""
        return Splats(*map(np.concatenate, zip(*parts, strict=True)))


def draw_splats(
    splats: Splats,
    camera: Cameras,
    size: tuple[int, int],
    *,
    background: tuple[int, int, int] = BACKGROUND,
    supersampling: int = 2,
    near: float = 0.0,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw points as one camera sees them; nearer ones hide farther ones, of equally far ones the last is seen.

    Args:
        splats: maybe none; those whose position is not finite are not drawn.
        camera: one camera, `camera_from_world` [3, 4] and `intrinsics` [3, 3] in pixels of the picture.
        size: width and height of the picture.
        background: where no point is seen.
        supersampling: pixels drawn for a pixel of the picture, along each side; their mean makes edges smooth.
        near: points at this depth or nearer are not drawn.

    Raises InputError for a side or a supersampling below 1, or more than 67 million drawn pixels.
    """
    factor = whole_number("supersampling", supersampling, 1)
    width, height = (factor * whole_number(name, side, 1) for name, side in zip(("width", "height"), size, strict=True))
    if width * height > _MOST_PIXELS:
        raise InputError(f"a picture of {size[0]} x {size[1]} pixels is too large; expected at most 16 million pixels")
    intrinsics = np.asarray(camera.intrinsics, np.float32) * np.array([[factor], [factor], [1]], np.float32)
    order, pixels, radii = _projected(splats, np.asarray(camera.camera_from_world), intrinsics, (width, height), near)
    ranks = _spread(pixels, radii, (width, height))
    palette = np.zeros((len(order) + 1, 4), np.uint8)  # four bytes, gathered as one number
    palette[:-1, :3], palette[-1, :3] = splats.colors[order], background  # rank -1: the background
    picture = palette.view(np.uint32)[:, 0][ranks].view(np.uint8).reshape(*ranks.shape, 4)
    return _mean(picture, factor)[..., :3]


def _mean(picture: UInt8[np.ndarray, "h w C"], factor: int) -> UInt8[np.ndarray, "H W C"]:
    """Return the rounded mean of squares of `factor` x `factor` pixels."""
    total = np.full(picture[::factor, ::factor].shape, factor**2 // 2, np.uint32)
    for row in range(factor):
        for column in range(factor):
            total += picture[row::factor, column::factor]
    return (total // factor**2).astype(np.uint8)


def pixel_radii(
    diameters: Float32[np.ndarray, " N"], depth: Float32[np.ndarray, " N"], focal: float
) -> Int[np.ndarray, " N"]:
    """Return radii r of discs of 2 r + 1 pixels: of a few up to 28 the least that is as wide as the point appears."""
    least = np.ceil(diameters * np.float32(focal / 2) / depth - np.float32(0.5))
    table = np.append(_RADII[np.searchsorted(_RADII, np.arange(_RADII[-1]))], _RADII[-1]).astype(np.int8)
    return table[least.clip(0, _RADII[-1]).astype(np.int8)]


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def _projected(
    splats: Splats,
    camera_from_world: Float[np.ndarray, "3 4"],
    intrinsics: Float32[np.ndarray, "3 3"],
    size: tuple[int, int],
    near: float,
) -> tuple[Int[np.ndarray, " M"], Int32[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Return the points centred in the picture from far to near, their pixels and radii."""
    x, y, depth = project(splats.positions, camera_from_world, intrinsics)
    width, height = size
    (seen,) = np.nonzero((depth > max(near, 0)) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    depth = depth[seen]
    far_first = np.uint64(0xFFFFFFFF) - depth.view(np.uint32)  # bits of floats above 0 are in the order of the floats
    keys = np.sort((far_first << np.uint64(32)) | np.arange(len(seen), dtype=np.uint64))
    order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
    chosen = seen[order]
    pixels = y[chosen].astype(np.int32) * np.int32(width) + x[chosen].astype(np.int32)
    return chosen, pixels, pixel_radii(splats.diameters[chosen], depth[order], float(intrinsics[0, 0]))


def _spread(
    pixels: Int32[np.ndarray, " M"], radii: Int[np.ndarray, " M"], size: tuple[int, int]
) -> Int32[np.ndarray, "H W"]:
    """Return the highest rank, a number of a point, of the discs that cover each pixel; -1 where there is none."""
    width, height = size
    ranks = np.full((height, width), -1, np.int32)
    for radius in np.unique(radii).tolist():
        (own,) = np.nonzero(radii == radius)
        centres = np.full(height * width, -1, np.int32)
        centres[pixels[own]] = own  # of points in one pixel the last stays, which is the nearest
        _spread_discs(centres.reshape(height, width), radius, ranks)
    return ranks


def _spread_discs(centres: Int32[np.ndarray, "H W"], radius: int, ranks: Int32[np.ndarray, "H W"]) -> None:
    """Raise `ranks` to the highest of `centres` in the disc around each pixel, whose rows are runs of pixels."""
    height, width = centres.shape
    runs, reached = centres.copy(), 0
    for down in range(radius, -1, -1):  # the runs grow towards the middle of the disc
        half_run = int(np.sqrt((radius + 0.5) ** 2 - down**2))  # pixels right of the middle column in this row
        for shift in range(reached + 1, half_run + 1):
            if shift < width:
                np.maximum(runs[:, shift:], centres[:, :-shift], out=runs[:, shift:])
                np.maximum(runs[:, :-shift], centres[:, shift:], out=runs[:, :-shift])
            reached = shift
        if down == 0:
            np.maximum(ranks, runs, out=ranks)
        elif down < height:
            np.maximum(ranks[down:], runs[:-down], out=ranks[down:])
            np.maximum(ranks[:-down], runs[down:], out=ranks[:-down])
