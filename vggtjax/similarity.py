"""Similarities of space, Sim(3): between points, of cameras, inverted and composed, in float64. Does not import jax."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from vggtjax.cameras import camera_centres, checked_poses
from vggtjax.errors import InputError

FEWEST_POSES = 3  # fewer centres can always be aligned exactly
_NO_MOTION = 1e-6  # a spread of centres below this share of their distance from the origin is float32's rounding
_NO_WIDTH = 1e-6  # of a line: its second extent is below this share of the first


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


def centres(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, "S 3"]:
    """Return the camera centres in the world, -R^T t."""
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
    moved = similarity.apply(centres(poses))
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
