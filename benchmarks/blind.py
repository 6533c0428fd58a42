"""Guesses of a trajectory that see no image, and their scores. Does not import jax."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from vggtjax.cameras import checked_poses
from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.trajectory import from_first
from vggtjax.geometry.similarity import centres

_TOLERANCE = 1e-8  # radians per frame
_FIRST_STEP = 0.02  # radians per frame; first step of the search


def still(frames: int) -> Float64[np.ndarray, "S 3 4"]:
    """Return cameras that neither turn nor move."""
    return np.tile(np.eye(3, 4), (frames, 1, 1))


def turning(angular_velocity: Float[np.ndarray, " 3"], frames: int) -> Float64[np.ndarray, "S 3 4"]:
    """Return cameras that turn at a constant rate, R_i = exp(i w), and do not move; w in radians per frame."""
    poses = still(frames)
    turns = np.arange(frames)[:, None] * np.asarray(angular_velocity, np.float64)
    poses[:, :, :3] = Rotation.from_rotvec(turns).as_matrix()
    return poses


def mean_angular_velocity(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, " 3"]:
    """Return log(R_i R_i-1^T) in radians per frame, averaged over the steps of a trajectory."""
    rotations = Rotation.from_matrix(_several(camera_from_world)[:, :, :3])
    return (rotations[1:] * rotations[:-1].inv()).as_rotvec().mean(axis=0)


def best_angular_velocity(truth: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, " 3"]:
    """Return the rate w, radians per frame, whose R_i = exp(i w) has the smallest rotation error against the truth.

    An oracle, because it reads the truth. The best of three searches by Nelder-Mead (the mean angle has kinks): from
    the rate with the truth's last rotation, from the mean of the steps, and from 0.
    """
    rotations = from_first(_several(truth))
    quaternions = rotations.as_quat()  # [S - 1, 4], xyzw
    times = np.arange(1, len(quaternions) + 1)

    def error(rate: Float64[np.ndarray, " 3"]) -> float:
        half = times * np.linalg.norm(rate) / 2
        vector = times[:, None] / 2 * np.sinc(half / np.pi)[:, None] * rate  # of the quaternion of exp(i w)
        cosine = np.abs((quaternions[:, :3] * vector).sum(axis=1) + quaternions[:, 3] * np.cos(half))
        return float(2 * np.arccos(np.minimum(cosine, 1)).mean())

    def descend(start: Float64[np.ndarray, " 3"]) -> tuple[float, Float64[np.ndarray, " 3"]]:
        simplex = start + _FIRST_STEP * np.eye(4, 3, -1)
        options = {"initial_simplex": simplex, "xatol": _TOLERANCE, "fatol": _TOLERANCE, "maxiter": 2000}
        optimum = minimize(error, start, method="Nelder-Mead", options=options)
        return float(optimum.fun), np.asarray(optimum.x, np.float64)

    starts = (rotations[-1].as_rotvec() / len(rotations), mean_angular_velocity(truth), np.zeros(3))
    return min((descend(start) for start in starts), key=lambda optimum: optimum[0])[1]


def still_centre_error(truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the RMSE of centres that all coincide: no similarity reduces the spread about their mean."""
    points = centres(_several(truth))
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def line_centre_error(truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the RMSE of centres on a line at equal steps, after Sim(3) alignment: that of linear regression."""
    points = centres(_several(truth))
    times = np.arange(len(points)) - (len(points) - 1) / 2
    offsets = points - points.mean(axis=0)
    velocity = times @ offsets / (times @ times)
    return float(np.sqrt(((offsets - times[:, None] * velocity) ** 2).sum(axis=1).mean()))


def _several(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, "S 3 4"]:
    poses = checked_poses(camera_from_world)
    if len(poses) < 2:
        raise InputError(f"a trajectory of {len(poses)} poses; expected at least 2")
    return poses
