"""Poses that keep given correspondences under other intrinsics: robust least squares. Does not import jax."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float64

from vggtjax.known.flow import Flow, moved_to, rays, seen_at

_NEAREST = 1e-3  # median depths; points nearer than that, or behind a camera, are taken to lie so far before it
_TOLERANCE = 1.0  # pixels; larger distances count linearly
_STEPS = 50
_DENSE = 150  # unknowns; more are solved with sparse matrices


class PoseFit(NamedTuple):
    """Poses, and the median distance in pixels between the correspondences and what these poses make of them."""

    camera_from_world: Float64[np.ndarray, "S 3 4"]
    residual: float  # not a number where there are no correspondences


def fit_poses(
    flow: Flow, camera_from_world: Float64[np.ndarray, "S 3 4"], intrinsics: Float64[np.ndarray, "S 3 3"]
) -> PoseFit:
    """Return the poses near the given ones under which the pixels land where the flow says.

    Every pixel, at its depth, is carried to the other frame. The sum over pixels of 2 (sqrt(1 + d^2) - 1) is smallest,
    where d is the distance in pixels (scipy's soft_l1). The first pose stays. Depths stay, so they set the scale.

    Args:
        flow: where pixels lie in other frames, and their depth.
        camera_from_world: the start.
        intrinsics: of both frames, in pixels of the flow.
    """
    problem = _Problem(flow, camera_from_world, intrinsics)
    count = 6 * (len(camera_from_world) - 1)
    if count == 0 or len(flow.source) == 0:
        return PoseFit(camera_from_world, math.nan)
    dense = count <= _DENSE

    def jacobian(x: Float64[np.ndarray, " P"]) -> Any:
        return problem.jacobian(x).toarray() if dense else problem.jacobian(x)

    made = scipy.optimize.least_squares(
        problem.offsets,
        np.zeros(count),
        jacobian,  # pyright: ignore[reportArgumentType] - of the stubs
        loss="soft_l1",
        f_scale=_TOLERANCE,
        max_nfev=_STEPS,
        tr_solver="exact" if dense else "lsmr",
    )
    distances = np.linalg.norm(problem.offsets(made.x).reshape(-1, 2), axis=1)
    return PoseFit(problem.poses(made.x)[0], float(np.median(distances)))


class _Problem:
    """Unknowns x: a rotation vector, then a shift in median depths, for every frame but the first."""

    def __init__(self, flow: Flow, poses: Float64[np.ndarray, "S 3 4"], K: Float64[np.ndarray, "S 3 3"]) -> None:
        self._flow, self._start, self._K = flow, poses, K
        self._unit = float(np.median(flow.depth)) if len(flow.depth) else 1.0
        self._points = rays(flow.pixels, K[flow.source]) * flow.depth[:, None]  # in the axes of the source frame

    def poses(self, x: Float64[np.ndarray, " P"]) -> tuple[Float64[np.ndarray, "S 3 4"], Float64[np.ndarray, "S 3"]]:
        """Return camera-from-world poses, and the rotation vectors."""
        turns, shifts = np.concatenate([np.zeros((1, 6)), x.reshape(-1, 6)]).reshape(-1, 2, 3).swapaxes(0, 1)
        rotation = scipy.spatial.transform.Rotation.from_rotvec(turns).as_matrix() @ self._start[:, :, :3]
        translation = self._start[:, :, 3] + self._unit * shifts
        return np.concatenate([rotation, translation[:, :, None]], axis=2), turns

    def _moved(self, poses: Float64[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, "N 3"]:
        points = moved_to(self._points, poses[self._flow.source], poses[self._flow.target])
        points[:, 2] = np.maximum(points[:, 2], _NEAREST * self._unit)
        return points

    def offsets(self, x: Float64[np.ndarray, " P"]) -> Float64[np.ndarray, " N*2"]:
        """Return by how many pixels the points miss their places."""
        return (seen_at(self._moved(self.poses(x)[0]), self._K[self._flow.target]) - self._flow.landed).ravel()

    def jacobian(self, x: Float64[np.ndarray, " P"]) -> scipy.sparse.csr_array:
        """Return the derivatives of the offsets."""
        i, j = self._flow.source, self._flow.target
        poses, turns = self.poses(x)
        points, focal = self._moved(poses), self._K[j][:, [0, 1], [0, 1]]
        pixels = np.zeros((len(i), 2, 3))  # of the points in the target frame
        pixels[:, [0, 1], [0, 1]] = focal / points[:, 2:]
        pixels[:, :, 2] = -focal * points[:, :2] / points[:, 2:] ** 2
        by_source = pixels @ (poses[j][:, :, :3] @ poses[i][:, :, :3].swapaxes(1, 2))
        tangent = _left_jacobian(turns)
        values = np.concatenate(
            [
                -pixels @ _cross(points - poses[j][:, :, 3]) @ tangent[j],
                pixels * self._unit,
                by_source @ _cross(self._points - poses[i][:, :, 3]) @ tangent[i],
                -by_source * self._unit,
            ],
            axis=2,
        )  # [N, 2, 12]
        columns = np.concatenate([6 * j[:, None] + np.arange(6), 6 * i[:, None] + np.arange(6)], axis=1)
        columns = np.broadcast_to(columns[:, None], values.shape)
        rows = np.broadcast_to(np.arange(2 * len(i)).reshape(-1, 2, 1), values.shape)
        shape = (2 * len(i), 6 * len(poses))
        return scipy.sparse.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)[:, 6:]


def _cross(vectors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3 3"]:
    """Return the matrices that take the cross product with the vectors from the left."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _left_jacobian(turns: Float64[np.ndarray, "S 3"]) -> Float64[np.ndarray, "S 3 3"]:
    """Return J with exp([w + dw]) = exp([J dw]) exp([w]) to first order."""
    angle = np.maximum(np.linalg.norm(turns, axis=1), 1e-6)[:, None, None]
    cross = _cross(turns)
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross
