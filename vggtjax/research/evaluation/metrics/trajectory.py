"""Camera trajectories against the truth: Sim(3) alignment and errors, in float64. Does not import jax."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from vggtjax.cameras import FEWEST_POSES, Similarity, checked_centres, checked_poses, umeyama_sim3
from vggtjax.cameras import align as moved
from vggtjax.cameras import moves as is_moving
from vggtjax.errors import InputError, check_choice
from vggtjax.storage.trajectories import associate as associate  # a step of every comparison with a recorded path

Alignment = Literal["sim3", "se3", "first"]


class TrajectoryErrors(NamedTuple):
    """RMSE of the centres, and of the steps between consecutive frames; see `trajectory_errors`."""

    ate: float  # in the truth's unit
    rte: float  # in the truth's unit
    rre: float  # degrees


def centre_error(predicted: Float[np.ndarray, "S 3 4"], truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the RMSE of the camera centres after Sim(3) alignment, in the truth's unit (ATE).

    Raises InputError for fewer than 3 poses, or a trajectory that does not move.
    """
    source, target = _moving(predicted, truth)
    return _rmse(umeyama_sim3(source, target, allow_line=True).apply(source) - target)


def rotation_error(predicted: Float[np.ndarray, "S 3 4"], truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the mean angle in degrees between rotations relative to frame 0, over frames 1 to S - 1.

    Nothing is aligned. Raises InputError for fewer than 2 poses, or different numbers of poses.
    """
    predicted, truth = _pair(predicted, truth, 2)
    return float(np.degrees((from_first(predicted) * from_first(truth).inv()).magnitude().mean()))


def from_first(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Rotation:
    """Return the rotations of frames 1 to S - 1 relative to frame 0: R_i R_0^T."""
    rotations = _rotations(checked_poses(camera_from_world))
    return rotations[1:] * rotations[0].inv()


def trajectory_errors(
    predicted: Float[np.ndarray, "S 4 4"], truth: Float[np.ndarray, "S 4 4"], align: Alignment = "sim3"
) -> TrajectoryErrors:
    """Return ATE, RTE and RRE of world-from-camera poses, as evo defines them.

    ATE is the RMSE of ||c_i - c*_i|| over the aligned centres; RTE and RRE are the RMSE of the translation and of the
    angle of E = (Q_i^-1 Q_i+1)^-1 (P_i^-1 P_i+1) over all consecutive pairs, P the aligned prediction, Q the truth.

    Args:
        predicted: rigid transforms, world from camera.
        truth: those of the same frames.
        align: "sim3" fits rotation, translation and scale to the centres first (Umeyama 1991), "se3" rotation and
            translation; "first" moves the first predicted pose to the true one and keeps the scale.

    Raises:
        InputError: poses that are not rigid [S, 4, 4], different numbers of poses, an unknown alignment. With "sim3"
            and "se3" also fewer than 3 poses or cameras that do not move, with "first" fewer than 2 poses.
    """
    check_choice("align", align, get_args(Alignment))
    source, target = _camera_from_world("predicted", predicted), _camera_from_world("true", truth)
    if align == "first":
        source, target = _pair(source, target, 2)
        rotation = target[0, :, :3].T @ source[0, :, :3]
        similarity = Similarity(1.0, rotation, checked_centres(target)[0] - rotation @ checked_centres(source)[0])
    else:
        similarity = umeyama_sim3(*_moving(source, target), allow_line=True, with_scale=align == "sim3")
    aligned = moved(source, similarity)
    (steps, moves), (true_steps, true_moves) = _steps(aligned), _steps(target)
    angles = (true_steps.inv() * steps).magnitude()
    return TrajectoryErrors(
        _rmse(checked_centres(aligned) - checked_centres(target)),
        _rmse(true_steps.inv().apply(moves - true_moves)),
        float(np.degrees(np.sqrt((angles**2).mean()))),
    )


def _rmse(offsets: Float64[np.ndarray, "S 3"]) -> float:
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


def _camera_from_world(name: str, world_from_camera) -> Float64[np.ndarray, "S 3 4"]:
    """Return inverted poses [S, 3, 4] with exact rotations."""
    poses = np.asarray(world_from_camera, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"the {name} poses have shape {poses.shape}; expected world-from-camera [S, 4, 4]")
    if not np.allclose(poses[:, 3], [0, 0, 0, 1]):
        raise InputError(f"the {name} poses are not rigid: expected their last rows to be 0, 0, 0, 1")
    inverse = _rotations(checked_poses(poses[:, :3])).inv()
    return np.concatenate([inverse.as_matrix(), -inverse.apply(poses[:, :3, 3])[:, :, None]], axis=2)


def _pair(predicted, truth, fewest: int) -> tuple[Float64[np.ndarray, "S 3 4"], Float64[np.ndarray, "S 3 4"]]:
    predicted, truth = checked_poses(predicted), checked_poses(truth)
    if len(predicted) != len(truth):
        raise InputError(f"{len(predicted)} predicted poses and {len(truth)} true ones; expected equal numbers")
    if len(truth) < fewest:
        raise InputError(f"a trajectory of {len(truth)} poses; expected at least {fewest}")
    return predicted, truth


def _moving(predicted, truth) -> tuple[Float64[np.ndarray, "S 3"], Float64[np.ndarray, "S 3"]]:
    predicted, truth = (checked_centres(poses) for poses in _pair(predicted, truth, FEWEST_POSES))
    for name, points in (("predicted", predicted), ("true", truth)):
        if not is_moving(points):
            raise InputError(f"the {name} cameras do not move; their centres cannot be aligned")
    return predicted, truth


def _steps(camera_from_world: Float64[np.ndarray, "S 3 4"]) -> tuple[Rotation, Float64[np.ndarray, "S-1 3"]]:
    """Return P_i^-1 P_i+1 of world-from-camera poses P: each camera relative to the camera before it."""
    rotations, positions = _rotations(camera_from_world), checked_centres(camera_from_world)
    return rotations[:-1] * rotations[1:].inv(), rotations[:-1].apply(np.diff(positions, axis=0))


def _rotations(poses: Float64[np.ndarray, "S 3 4"]) -> Rotation:
    return Rotation.from_matrix(poses[:, :, :3])
