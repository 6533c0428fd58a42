"""Camera trajectories against the truth: Sim(3) alignment and errors, in float64. Does not import jax."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from vggtjax.errors import InputError, check_choice

Alignment = Literal["sim3", "se3", "first"]

FEWEST_POSES = 3  # fewer centres can always be aligned exactly
_NO_MOTION = 1e-6  # a spread of centres below this share of their distance from the origin is float32's rounding
_NO_WIDTH = 1e-6  # of a line: its second extent is below this share of the first
_NOT_RIGID = 1e-2  # largest difference of R^T R from the identity
_WIDER = 1.01  # times the tolerance is the search range for partners: sums of times are rounded
_MOST_CANDIDATES = 10_000_000  # pairs of timestamps within the tolerance; 160 MB of indices


class Similarity(NamedTuple):
    """A Sim(3) transform: x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    def apply(self, points: Float[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 3"]:
        """Return the transformed points."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation


class TrajectoryErrors(NamedTuple):
    """RMSE of the centres, and of the steps between consecutive frames; see `trajectory_errors`."""

    ate: float  # in the truth's unit
    rte: float  # in the truth's unit
    rre: float  # degrees


def centres(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, "S 3"]:
    """Return the camera centres in the world, -R^T t."""
    poses = checked_poses(camera_from_world)
    return -np.einsum("sji,sj->si", poses[:, :, :3], poses[:, :, 3])


def umeyama_sim3(
    source: Float[np.ndarray, "N 3"],
    target: Float[np.ndarray, "N 3"],
    *,
    allow_line: bool = False,
    with_scale: bool = True,
) -> Similarity:
    """Return the similarity from `source` to `target` with the least squared error (Umeyama 1991).

    Args:
        source, target: corresponding points.
        allow_line: accept points on one line. The rotation around the line is then arbitrary; scale and remaining error
            do not depend on it.
        with_scale: False keeps the scale at 1: the best rotation and translation, SE(3).

    Raises:
        InputError: different shapes, values that are not finite, fewer than 3 points, points that all coincide, or
            (unless allowed) points on one line.
    """
    source, target = (_points(name, points) for name, points in (("source", source), ("target", target)))
    if len(source) != len(target):
        raise InputError(f"source has {len(source)} points and target {len(target)}; expected equal numbers")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    left, values, right = np.linalg.svd((target - mean_target).T @ (source - mean_source) / len(source))
    for name, points, mean in (("source", source, mean_source), ("target", target, mean_target)):
        extents = np.linalg.svd(points - mean, compute_uv=False)
        if not moves(points):
            raise InputError(f"the {len(points)} {name} points all coincide; an alignment needs motion")
        if not allow_line and extents[1] < _NO_WIDTH * extents[0]:
            raise InputError(f"the {name} points lie on one line; the rotation around it is unknown")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ (signs[:, None] * right)
    scale = float(values @ signs / ((source - mean_source) ** 2).sum(axis=1).mean()) if with_scale else 1.0
    if scale <= 0:
        raise InputError("source and target points are not correlated: no positive scale fits")
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def align(camera_from_world: Float[np.ndarray, "S 3 4"], similarity: Similarity) -> Float64[np.ndarray, "S 3 4"]:
    """Return the same cameras in the transformed world: centres and orientations moved, images unchanged."""
    poses = checked_poses(camera_from_world)
    rotation = poses[:, :, :3] @ similarity.rotation.T
    moved = similarity.apply(centres(poses))
    return np.concatenate([rotation, -np.einsum("sij,sj->si", rotation, moved)[:, :, None]], axis=2)


def centre_error(predicted: Float[np.ndarray, "S 3 4"], truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the RMSE of the camera centres after Sim(3) alignment, in the truth's unit (ATE).

    Raises InputError for fewer than 3 poses, or a trajectory that does not move.
    """
    source, target = _pair_of_centres(predicted, truth)
    offsets = umeyama_sim3(source, target, allow_line=True).apply(source) - target
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


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
    fewest = 2 if align == "first" else FEWEST_POSES
    source, target = _pair(_camera_from_world("predicted", predicted), _camera_from_world("true", truth), fewest)
    aligned = _onto(source, target, align)
    offsets = centres(aligned) - centres(target)
    return TrajectoryErrors(float(np.sqrt((offsets**2).sum(axis=1).mean())), *_step_errors(aligned, target))


def associate(
    times: Float[np.ndarray, " N"], other_times: Float[np.ndarray, " M"], tolerance: float = 0.02
) -> Int[np.ndarray, "K 2"]:
    """Return pairs of timestamps, as TUM's tools for RGB-D sequences pair them.

    Of all pairs less than `tolerance` apart the closest comes first, then the closest pair of unpaired timestamps, and
    so on.

    Args:
        times: seconds, in any order.
        other_times: seconds, in any order.
        tolerance: seconds; a pair exactly as far apart does not count.

    Returns:
        Indices into `times` and `other_times`, in the order of `times`; empty if no pair is close enough.

    Raises:
        InputError: times that are not finite or not one-dimensional, a tolerance that is not above 0, or more than ten
            million pairs within the tolerance.
    """
    first, second = (_timestamps(name, values) for name, values in (("times", times), ("other_times", other_times)))
    if not tolerance > 0:
        raise InputError(f"tolerance is {tolerance}; expected seconds above 0")
    order = np.argsort(second, kind="stable")
    starts = np.searchsorted(second[order], first - _WIDER * tolerance, side="left")
    counts = np.searchsorted(second[order], first + _WIDER * tolerance, side="right") - starts
    if counts.sum() > _MOST_CANDIDATES:
        raise InputError(f"{counts.sum()} pairs of times are within {tolerance} s; expected a smaller tolerance")
    left = np.repeat(np.arange(len(first)), counts)
    offsets = np.arange(len(left)) - np.repeat(counts.cumsum() - counts, counts)
    right = order[np.repeat(starts, counts) + offsets]
    apart = np.abs(first[left] - second[right])
    near = np.flatnonzero(apart < tolerance)
    near = near[np.lexsort((second[right[near]], first[left[near]], apart[near]))]
    partner = np.full(len(first), -1)
    taken = np.zeros(len(second), bool)
    for i, j in zip(left[near].tolist(), right[near].tolist(), strict=True):
        if partner[i] < 0 and not taken[j]:
            partner[i], taken[j] = j, True
    paired = np.flatnonzero(partner >= 0)
    paired = paired[np.argsort(first[paired], kind="stable")]
    return np.stack([paired, partner[paired]], axis=1)


def _step_errors(aligned: Float64[np.ndarray, "S 3 4"], truth: Float64[np.ndarray, "S 3 4"]) -> tuple[float, float]:
    """Return RTE and RRE of camera-from-world poses in one world."""
    (rotation, translation), (true_rotation, true_translation) = _steps(aligned), _steps(truth)
    offsets = true_rotation.inv().apply(translation - true_translation)
    angles = (true_rotation.inv() * rotation).magnitude()
    return float(np.sqrt((offsets**2).sum(axis=1).mean())), float(np.degrees(np.sqrt((angles**2).mean())))


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


def _camera_from_world(name: str, world_from_camera) -> Float64[np.ndarray, "S 3 4"]:
    """Return inverted poses [S, 3, 4] with exact rotations."""
    poses = np.asarray(world_from_camera, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"the {name} poses have shape {poses.shape}; expected world-from-camera [S, 4, 4]")
    if not np.allclose(poses[:, 3], [0, 0, 0, 1]):
        raise InputError(f"the {name} poses are not rigid: expected their last rows to be 0, 0, 0, 1")
    inverse = _rotations(checked_poses(poses[:, :3])).inv()
    return np.concatenate([inverse.as_matrix(), -inverse.apply(poses[:, :3, 3])[:, :, None]], axis=2)


def _onto(predicted: Float64[np.ndarray, "S 3 4"], truth: Float64[np.ndarray, "S 3 4"], how: Alignment):
    """Return the predicted camera-from-world poses in the world of the true ones."""
    if how != "first":
        pair = _pair_of_centres(predicted, truth)
        return align(predicted, umeyama_sim3(*pair, allow_line=True, with_scale=how == "sim3"))
    rotation = truth[0, :, :3].T @ predicted[0, :, :3]
    return align(predicted, Similarity(1.0, rotation, centres(truth)[0] - rotation @ centres(predicted)[0]))


def _timestamps(name: str, times) -> Float64[np.ndarray, " N"]:
    times = np.asarray(times, np.float64)
    if times.ndim != 1 or not np.isfinite(times).all():
        raise InputError(f"{name} has shape {times.shape}; expected finite seconds [N]")
    return times


def _pair(predicted, truth, fewest: int) -> tuple[Float64[np.ndarray, "S 3 4"], Float64[np.ndarray, "S 3 4"]]:
    predicted, truth = checked_poses(predicted), checked_poses(truth)
    if len(predicted) != len(truth):
        raise InputError(f"{len(predicted)} predicted poses and {len(truth)} true ones; expected equal numbers")
    if len(truth) < fewest:
        raise InputError(f"a trajectory of {len(truth)} poses; expected at least {fewest}")
    return predicted, truth


def _pair_of_centres(predicted, truth) -> tuple[Float64[np.ndarray, "S 3"], Float64[np.ndarray, "S 3"]]:
    predicted, truth = (centres(poses) for poses in _pair(predicted, truth, FEWEST_POSES))
    for name, points in (("predicted", predicted), ("true", truth)):
        if not moves(points):
            raise InputError(f"the {name} cameras do not move; their centres cannot be aligned")
    return predicted, truth


def moves(points: Float[np.ndarray, "N 3"]) -> bool:
    """Return whether points differ by more than rounding errors."""
    points = np.asarray(points, np.float64)
    return bool(np.linalg.norm(points - points.mean(axis=0)) > _NO_MOTION * np.linalg.norm(points))


def _steps(camera_from_world: Float64[np.ndarray, "S 3 4"]) -> tuple[Rotation, Float64[np.ndarray, "S-1 3"]]:
    """Return P_i^-1 P_i+1 of world-from-camera poses P: each camera relative to the camera before it."""
    rotations, positions = _rotations(camera_from_world), centres(camera_from_world)
    return rotations[:-1] * rotations[1:].inv(), rotations[:-1].apply(np.diff(positions, axis=0))


def _rotations(poses: Float64[np.ndarray, "S 3 4"]) -> Rotation:
    return Rotation.from_matrix(poses[:, :, :3])


def _points(name: str, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} points have shape {points.shape}; expected [N, 3]")
    if len(points) < FEWEST_POSES:
        raise InputError(f"{len(points)} {name} points; expected at least {FEWEST_POSES}")
    if not np.isfinite(points).all():
        raise InputError(f"{name} points have values that are not finite")
    return points
