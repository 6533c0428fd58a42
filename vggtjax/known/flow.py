"""The correspondences that depth and cameras imply: where pixels of one frame lie in others. Does not import jax."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from vggtjax.results.result import Result

_OFFSETS = (1, 2, 4, 8, 16)  # between the two frames of a pair
_SIDE = 8  # pixels are drawn from a grid of so many columns and rows of a frame


class Flow(NamedTuple):
    """N pixels of a frame, their depth, and where they lie in another frame; pixel edges at whole numbers."""

    source: Int64[np.ndarray, " N"]  # frame
    target: Int64[np.ndarray, " N"]  # another frame
    pixels: Float64[np.ndarray, "N 2"]  # x, y in the source frame
    depth: Float64[np.ndarray, " N"]  # in the source frame
    landed: Float64[np.ndarray, "N 2"]  # x, y in the target frame


def rays(pixels: Float64[np.ndarray, "N 2"], intrinsics: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "N 3"]:
    """Return the points of depth 1 that pixels show."""
    focal, middle = intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2]
    return np.column_stack([(pixels - middle) / focal, np.ones(len(pixels))])


def seen_at(points: Float64[np.ndarray, "N 3"], intrinsics: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "N 2"]:
    """Return the pixels that show points in front of cameras, given in the cameras' axes."""
    focal, middle = intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2]
    return points[:, :2] / points[:, 2:] * focal + middle


def moved_to(
    points: Float64[np.ndarray, "N 3"],
    source: Float64[np.ndarray, "N 3 4"],
    target: Float64[np.ndarray, "N 3 4"],
) -> Float64[np.ndarray, "N 3"]:
    """Return points in the axes of the source cameras in those of the target cameras."""
    world = np.einsum("nji,nj->ni", source[:, :, :3], points - source[:, :, 3])
    return np.einsum("nij,nj->ni", target[:, :, :3], world) + target[:, :, 3]


def reliable_pixels(result: Result) -> Bool[np.ndarray, "S H W"]:
    """Return pixels that show a static point whose confidence is not among the lowest fifth of the clip."""
    used = result.valid_pixels & ~result.dynamic_mask
    if not used.any():
        return used
    return used & (result.depth_confidence >= np.percentile(result.depth_confidence[used], 20))


def implied_flow(result: Result) -> Flow:
    """Return where reliable pixels of every frame lie in the frames 1, 2, 4, 8 and 16 before and after it.

    Pixels that leave the picture are left out. The order of the pixels does not depend on chance.
    """
    frames, height, width = result.depth.shape
    poses = result.camera_from_world.astype(np.float64)
    K = result.intrinsics.astype(np.float64)
    reliable = reliable_pixels(result)
    rows, columns = (np.unique(((np.arange(_SIDE) + 0.5) / _SIDE * size).astype(int)) for size in (height, width))
    grid = np.zeros((height, width), bool)
    grid[np.ix_(rows, columns)] = True
    frame, row, column = np.nonzero(reliable & grid)
    found = []
    for offset in (sign * step for step in _OFFSETS for sign in (1, -1)):
        inside = (frame + offset >= 0) & (frame + offset < frames)
        i, y, x = frame[inside], row[inside], column[inside]
        j = i + offset
        pixels = np.column_stack([x, y]) + 0.5
        depth = result.depth[i, y, x].astype(np.float64)
        points = moved_to(rays(pixels, K[i]) * depth[:, None], poses[i], poses[j])
        with np.errstate(divide="ignore", invalid="ignore"):
            landed = seen_at(points, K[j])
        left, top, right, bottom = result.valid_box[j].T
        kept = (points[:, 2] > 0) & (landed[:, 0] > left) & (landed[:, 0] < right)
        kept &= (landed[:, 1] > top) & (landed[:, 1] < bottom)
        found.append(Flow(i[kept], j[kept], pixels[kept], depth[kept], landed[kept]))
    return Flow(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
