"""Cameras of data sets in this library's conventions. Does not import jax."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from vggtjax.cameras import checked_poses, world_from_camera
from vggtjax.errors import InputError

DISTORTED = "lens distortion is not undone, and not part of the intrinsics"  # a note
TURNED = (
    ". Pictures that are stored on their side are read upright, as their EXIF orientation says; write them upright, "
    "such as by mogrify -auto-orient, and make what belongs to them anew"
)
PIXEL_CENTRE = 0.5  # of the first pixel; 0 for data sets that count from the centre


def intrinsics_matrix(
    fx: float, fy: float, cx: float, cy: float, *, first_pixel: float, source: Path | str
) -> Float64[np.ndarray, "3 3"]:
    """Return intrinsics in pixels, from those of a data set whose first pixel has its centre at `first_pixel`.

    Raises InputError, which names `source`, where the numbers are not finite or a focal length is not above 0.
    """
    shift = PIXEL_CENTRE - first_pixel
    matrix = np.array([[fx, 0, cx + shift], [0, fy, cy + shift], [0, 0, 1]], np.float64)
    return checked_intrinsics(matrix, source)


def checked_intrinsics(matrices: Float64[np.ndarray, "*S 3 3"], source: Path | str) -> Float64[np.ndarray, "*S 3 3"]:
    """Return intrinsics, or raise InputError where they are not finite or a focal length is not above 0."""
    focal = matrices[..., [0, 1], [0, 1]]
    if not np.isfinite(matrices).all() or (focal <= 0).any() or not (matrices[..., 2, :] == [0, 0, 1]).all():
        raise InputError(f"{source} has invalid intrinsics; expected focal lengths above 0 and a last row 0 0 1")
    return matrices


def resized_intrinsics(
    matrix: Float64[np.ndarray, "3 3"], size: tuple[int, int], picture: tuple[int, int], source: Path
) -> Float64[np.ndarray, "3 3"]:
    """Return intrinsics of pictures of one (width, height) at another; raises InputError for another shape."""
    scale = np.array(picture) / np.array(size)
    if abs(size[0] * picture[1] - size[1] * picture[0]) > max(picture):  # one pixel of difference is rounding
        across = abs(size[1] * picture[1] - size[0] * picture[0]) <= max(picture)
        raise InputError(
            f"{source} is for pictures of {size[0]:g} x {size[1]:g} and the picture is {picture[0]} x {picture[1]}; "
            f"expected the same shape{TURNED if across else ''}"
        )
    resized = matrix.copy()
    resized[:2] *= scale[:, None]
    return resized


def checked_world_from_camera(poses: Float[np.ndarray, "S 4 4"], source: Path | str) -> Float64[np.ndarray, "S 4 4"]:
    """Return poses in float64, or raise InputError, which names `source`, where they are not rigid."""
    poses = np.asarray(poses, np.float64)
    try:
        checked_poses(poses[:, :3])
    except InputError as error:
        raise InputError(f"{source} has invalid poses: {error}") from None
    if not np.allclose(poses[:, 3], [0, 0, 0, 1]):
        raise InputError(f"{source} has invalid poses: their last row is not 0 0 0 1")
    return poses


def with_lost_poses(poses: Float[np.ndarray, "S 4 4"], source: Path | str) -> Float64[np.ndarray, "S 4 4"]:
    """Return poses, NaN for lost frames: those that are not finite, as ScanNet writes them, or 0 throughout.

    Raises what `checked_world_from_camera` raises for the others.
    """
    poses = np.array(poses, np.float64)
    lost = np.asarray(~np.isfinite(poses).all(axis=(1, 2)) | ~poses[:, :3].any(axis=(1, 2)))
    checked_world_from_camera(np.where(lost[:, None, None], np.eye(4), poses), source)
    poses[lost] = np.nan
    return poses


def world_from_camera_of(
    camera_from_world: Float[np.ndarray, "S 3 4"], source: Path | str
) -> Float64[np.ndarray, "S 4 4"]:
    """Return the inverse of poses; raises what `checked_world_from_camera` raises."""
    return checked_world_from_camera(world_from_camera(np.asarray(camera_from_world, np.float64)), source)


def from_opengl(poses: Float[np.ndarray, "S 4 4"], source: Path | str) -> Float64[np.ndarray, "S 4 4"]:
    """Return world-from-camera poses of cameras in OpenGL's axes (y up, z backward) as those of OpenCV's.

    The world stays as it is. Raises what `checked_world_from_camera` raises.
    """
    return checked_world_from_camera(poses, source) @ np.diag([1.0, -1.0, -1.0, 1.0])
