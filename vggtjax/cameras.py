"""Pinhole cameras: inverses, unprojection, fields of view, frusta; similarities Sim(3) between their worlds.

Axes are OpenCV's: x right, y down, z forward. Pixel coordinates put edges at integers: a picture spans
[0, W] x [0, H] and the centre of its first pixel is (0.5, 0.5).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Float32, Float64

from vggtjax.errors import InputError, ResultError

if TYPE_CHECKING:
    import jax

_Array = TypeVar("_Array", np.ndarray, "jax.Array")

FIELD_OF_VIEW_RANGE = (0.01, 3.1)  # radians; beyond it a pinhole camera has no usable focal length
_NOT_RIGID = 1e-2  # largest difference of R^T R from the identity
_FIELD_OF_VIEW_SLACK = 1e-6  # radians; a clamped camera that went through float32 is not clamped again
FEWEST_POSES = 3  # fewer centres can always be aligned exactly
_NO_MOTION = 1e-6  # a spread of centres below this share of their distance from the origin is float32's rounding
_NO_WIDTH = 1e-6  # of a line: its second extent is below this share of the first
# Corners of `frustum_corners`: 0 the centre, then 1 top left, 2 top right, 3 bottom right, 4 bottom left.
FRUSTUM_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])


class Cameras(NamedTuple):
    """Cameras of frames, of numpy or jax; intrinsics are in pixels."""

    camera_from_world: Float[Any, "*F 3 4"]
    intrinsics: Float[Any, "*F 3 3"]


def checked_poses(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, "S 3 4"]:
    """Return poses in float64; raises InputError unless they are rigid transforms [S, 3, 4]."""
    poses = np.asarray(camera_from_world, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (3, 4):
        raise InputError(f"camera poses have shape {poses.shape}; expected [S, 3, 4]")
    if not np.isfinite(poses).all():
        raise InputError("camera poses have values that are not finite; expected rotations and translations")
    rotation = poses[:, :, :3]
    skewed = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) > _NOT_RIGID
    if (wrong := np.flatnonzero(skewed | (np.linalg.det(rotation) < 0))).size:
        raise InputError(f"the camera pose of frame {wrong[0]} is not a rotation and a translation")
    return poses


def camera_centres(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float[np.ndarray, "S 3"]:
    """Return the camera centres in the world, -R^T t."""
    rotation, translation = camera_from_world[..., :3], camera_from_world[..., 3]
    return -np.einsum("sji,sj->si", rotation, translation)


def world_from_camera(camera_from_world: Float32[np.ndarray, "S 3 4"]) -> Float32[np.ndarray, "S 4 4"]:
    """Invert rigid transforms: rotation R^T, translation -R^T t, last row (0, 0, 0, 1)."""
    inverse = np.zeros((len(camera_from_world), 4, 4), camera_from_world.dtype)
    inverse[:, :3, :3] = camera_from_world[..., :3].swapaxes(-1, -2)
    inverse[:, :3, 3] = camera_centres(camera_from_world)
    inverse[:, 3, 3] = 1
    return inverse


def unproject(
    depth: Float[_Array, "*F H W"],
    intrinsics: Float[_Array, "*F 3 3"],
    camera_from_world: Float[_Array, "*F 3 4"],
    *,
    pixel_offset: float,
) -> Float[_Array, "*F H W 3"]:
    """Lift every pixel to its point in the world, on the host or, given jax arrays, on the device.

    Args:
        depth: z in the camera; a non-finite depth gives a non-finite point.
        intrinsics: focal lengths and principal point in pixels of `depth`; skew is not used.
        camera_from_world: rigid transforms.
        pixel_offset: where in its cell a pixel is seen. 0.5, the centre, is right for principal points at (W/2, H/2);
            0.0, the corner, is used by VGGT's public code and shifts the points by half a pixel.
    """
    xp: Any = depth.__array_namespace__()
    *frames, H, W = depth.shape
    one = (1,) * len(frames)
    u = (xp.arange(W, dtype=depth.dtype) + pixel_offset).reshape(*one, 1, W)
    v = (xp.arange(H, dtype=depth.dtype) + pixel_offset).reshape(*one, H, 1)
    K, translation = intrinsics[..., None, None], camera_from_world[..., None, None, :, 3]
    right = (u - K[..., 0, 2, :, :]) / K[..., 0, 0, :, :]  # [*F, 1, W]
    down = (v - K[..., 1, 2, :, :]) / K[..., 1, 1, :, :]  # [*F, H, 1]
    with np.errstate(over="ignore", invalid="ignore"):
        points = xp.stack([right * depth, down * depth, depth], axis=-1)
        points -= translation
        points = points.reshape(*frames, H * W, 3) @ camera_from_world[..., :3]  # row vectors: p R is R^T p
    return points.reshape(*frames, H, W, 3)


def zoomed(intrinsics: Float[np.ndarray, "S 3 3"], factor: float) -> Float[np.ndarray, "S 3 3"]:
    """Return intrinsics with focal lengths times a factor."""
    changed = intrinsics.copy()
    changed[:, [0, 1], [0, 1]] *= factor
    return changed


def project(
    points: Float[np.ndarray, "N 3"], camera_from_world: Float[np.ndarray, "3 4"], intrinsics: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return x and y in pixels, and depth, in the type of the points; x and y are only right where depth is above 0."""
    pose, K = camera_from_world.astype(points.dtype), intrinsics.astype(points.dtype)
    right, down, away = (
        points[:, 0] * pose[axis, 0] + points[:, 1] * pose[axis, 1] + points[:, 2] * pose[axis, 2] + pose[axis, 3]
        for axis in range(3)
    )
    return right / away * K[0, 0] + K[0, 2], down / away * K[1, 1] + K[1, 2], away


def clamp_field_of_view(fov: Float[np.ndarray, "S 2"]) -> tuple[Float[np.ndarray, "S 2"], tuple[int, ...]]:
    """Clamp fields of view, two radians a frame, to FIELD_OF_VIEW_RANGE: untrained weights give 0 or more than pi.

    Returns the angles (those inside the range are unchanged) and the frames with a clamped angle. Raises ResultError
    for an angle that is not a number.
    """
    lowest, highest = FIELD_OF_VIEW_RANGE
    undefined = np.flatnonzero(np.isnan(fov).any(axis=-1))
    if undefined.size:
        raise ResultError(
            f"the field of view of frame {undefined[0]} is not a number; expected radians in [{lowest}, {highest}]"
        )
    outside = (fov < lowest - _FIELD_OF_VIEW_SLACK) | (fov > highest + _FIELD_OF_VIEW_SLACK)
    frames = tuple(int(frame) for frame in np.flatnonzero(outside.any(axis=-1)))
    return np.where(outside, np.clip(fov, lowest, highest), fov), frames


def clamp_intrinsics(
    intrinsics: Float32[np.ndarray, "S 3 3"], height: int, width: int
) -> tuple[Float32[np.ndarray, "S 3 3"], tuple[int, ...]]:
    """Clamp the fields of view behind focal lengths; returns and raises what `clamp_field_of_view` does.

    A field of view of 0 arrives as an infinite focal length and one beyond pi as a negative one. The principal
    points are expected at (W/2, H/2) and stay as they are.
    """
    half = np.array([width, height]) / 2
    focal = np.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], axis=-1).astype(np.float64)
    fov = 2 * np.arctan2(half, focal)
    clamped, frames = clamp_field_of_view(fov)
    focal = np.where(clamped == fov, focal, half / np.tan(clamped / 2))
    intrinsics = intrinsics.copy()
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = focal[:, 0], focal[:, 1]
    return intrinsics, frames


def frustum_corners(
    intrinsics: Float[np.ndarray, "S 3 3"],
    camera_from_world: Float[np.ndarray, "S 3 4"],
    height: int,
    width: int,
    size: float,
) -> Float[np.ndarray, "S 5 3"]:
    """Return the world points that outline each camera: its centre, then the picture's corners.

    Corners go top left, top right, bottom right, bottom left, `size` away from the centre along their rays, so that
    a very wide camera is drawn no larger than the others.
    """
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    focal, principal_point = intrinsics[:, None, [0, 1], [0, 1]], intrinsics[:, None, :2, 2]
    rays = np.ones((len(intrinsics), 4, 3), np.float32)
    rays[..., :2] = (pixels - principal_point) / focal
    rays *= np.float32(size) / np.linalg.norm(rays, axis=-1, keepdims=True)
    centres = camera_centres(camera_from_world)[:, None]
    return np.concatenate([centres, centres + rays @ camera_from_world[..., :3]], axis=1)


class Similarity(NamedTuple):
    """A Sim(3) transform: x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    def apply(self, points: Float[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 3"]:
        """Return the transformed points."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def inverse(self) -> Similarity:
        """Return the transform that undoes this one."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def after(self, first: Similarity) -> Similarity:
        """Return the transform that applies `first`, then this one."""
        rotation = self.rotation @ first.rotation
        return Similarity(self.scale * first.scale, rotation, self.apply(first.translation[None])[0])


def checked_centres(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, "S 3"]:
    """Return the camera centres in float64; raises InputError for poses that are not rigid."""
    return camera_centres(checked_poses(camera_from_world))


def umeyama_sim3(
    source: Float[np.ndarray, "N 3"],
    target: Float[np.ndarray, "N 3"],
    *,
    weights: Float[np.ndarray, " N"] | None = None,
    allow_line: bool = False,
    with_scale: bool = True,
) -> Similarity:
    """Return the similarity from `source` to `target` with the least squared error (Umeyama 1991).

    Args:
        source, target: corresponding points.
        weights: of their squared errors, at least 0 and not all 0; equal ones by default.
        allow_line: accept points on one line. The rotation around the line is then arbitrary; scale and remaining error
            do not depend on it.
        with_scale: False keeps the scale at 1: the best rotation and translation, SE(3).

    Raises:
        InputError: different shapes or numbers of weights, values that are not finite, fewer than 3 points, points that
            all coincide, or (unless allowed) points on one line.
    """
    source, target = (_points(name, points) for name, points in (("source", source), ("target", target)))
    if len(source) != len(target):
        raise InputError(f"source has {len(source)} points and target {len(target)}; expected equal numbers")
    if weights is not None and len(weights) != len(source):
        raise InputError(f"{len(weights)} weights for {len(source)} points; expected equal numbers")
    shares = np.full(len(source), 1 / len(source)) if weights is None else weights / weights.sum()
    mean_source, mean_target = shares @ source, shares @ target
    left, values, right = np.linalg.svd((shares[:, None] * (target - mean_target)).T @ (source - mean_source))
    for name, points, mean in (("source", source, mean_source), ("target", target, mean_target)):
        if not moves(points):
            raise InputError(f"the {len(points)} {name} points all coincide; an alignment needs motion")
        if not allow_line and _on_one_line(points - mean):
            raise InputError(f"the {name} points lie on one line; the rotation around it is unknown")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ (signs[:, None] * right)
    scale = float(values @ signs / (shares @ ((source - mean_source) ** 2).sum(axis=1))) if with_scale else 1.0
    if scale <= 0:
        raise InputError("source and target points are not correlated: no positive scale fits")
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def align(camera_from_world: Float[np.ndarray, "S 3 4"], similarity: Similarity) -> Float64[np.ndarray, "S 3 4"]:
    """Return the same cameras in the transformed world: centres and orientations moved, images unchanged."""
    poses = checked_poses(camera_from_world)
    rotation = poses[:, :, :3] @ similarity.rotation.T
    moved = similarity.apply(camera_centres(poses))
    return np.concatenate([rotation, -np.einsum("sij,sj->si", rotation, moved)[:, :, None]], axis=2)


def moves(points: Float[np.ndarray, "N 3"]) -> bool:
    """Return whether points differ by more than rounding errors."""
    points = np.asarray(points, np.float64)
    return bool(np.linalg.norm(points - points.mean(axis=0)) > _NO_MOTION * np.linalg.norm(points))


def _points(name: str, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} points have shape {points.shape}; expected [N, 3]")
    if len(points) < FEWEST_POSES:
        raise InputError(f"{len(points)} {name} points; expected at least {FEWEST_POSES}")
    if not np.isfinite(points).all():
        raise InputError(f"{name} points have values that are not finite")
    return points


def _on_one_line(offsets: Float64[np.ndarray, "N 3"]) -> bool:
    extents = np.linalg.svd(offsets, compute_uv=False)
    return bool(extents[1] < _NO_WIDTH * extents[0])
