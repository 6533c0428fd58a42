"""Known poses: read, matched to frames, and compared with predicted ones. Does not import jax."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float64

from vggtjax.cameras import camera_centres, world_from_camera
from vggtjax.clips.captures.cameras import checked_world_from_camera
from vggtjax.clips.clip import Clip
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.times import in_seconds, name_times
from vggtjax.errors import InputError
from vggtjax.results.result import Result
from vggtjax.storage.trajectories import Quaternion, associate, named_order, read_numbers, read_trajectory

_TUM = 8  # numbers a line; others are matrices
_MATRICES = (12, 16, 4)  # of three rows, of four, and of four a row a line
_UNNAMED = "pred_traj.txt"  # of VGGT4D, MonST3R and CUT3R: without names of columns, and the quaternion's w is first
_FEWEST = 3
_NO_MOTION = 1e-6  # a path, or its share of the distance from the origin, below which cameras stand still
_FAR_AWAY = 1e-2  # share of the distance from the origin; steps between frames lose a thousandth to 32 bits
_MOST_TURN = 45.0  # degrees; poses that differ more in the middle belong to another clip
_RESIDUAL, _LESS = 5.0, 1 / 3  # of `_residual`; the share of it left in another convention, which is then right


logger = logging.getLogger(__name__)


class PoseAgreement(NamedTuple):
    """How predicted poses differ from known ones after the best rotation, scale and shift of their world."""

    turn_median: float  # degrees
    turn_most: float  # degrees
    centres: float  # RMSE over the length of the known path
    scale: float  # of predicted lengths


def pose_table(
    path: str | Path, quaternion: Quaternion | None = None
) -> tuple[Float64[np.ndarray, " N"] | None, Float64[np.ndarray, "N 4 4"]]:
    """Return the times, if there are any, and the poses of a text file.

    Lines have TUM's eight numbers, with quaternions in the order that is given, that the first lines name, or in TUM's;
    twelve or sixteen of a matrix, row by row; or four, a row of a matrix each. Raises InputError or ResultError for an
    unreadable file, an order with matrices, or none with a file whose name is that of programs with w first.
    """
    rows = read_numbers(path, (_TUM, *_MATRICES))
    if rows.shape[1] == _TUM:
        if quaternion is None and Path(path).name == _UNNAMED and named_order(path) is None:
            raise InputError(
                f"{path} does not say the order of its quaternions; give --quaternion wxyz, as VGGT4D, MonST3R, CUT3R "
                "and vggtjax write such files, or xyzw"
            )
        return read_trajectory(path, quaternion)
    if quaternion is not None:
        raise InputError(f"quaternion is {quaternion!r}, but {path} has matrices; leave --quaternion out")
    if rows.shape[1] == 4 and len(rows) % 4:
        raise InputError(f"{path} has {len(rows)} rows of four numbers; expected four rows for each pose")
    poses = np.tile(np.eye(4), (len(rows) if rows.shape[1] > 4 else len(rows) // 4, 1, 1))
    if rows.shape[1] == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
    else:
        poses[:] = rows.reshape(-1, 4, 4)
    return None, poses


def read_poses(
    path: str | Path, clip: Clip | Result, quaternion: Quaternion | None = None
) -> Float64[np.ndarray, "S 4 4"]:
    """Return the world-from-camera poses of a clip's frames; `pose_table` says which files are read.

    Of poses with times every frame takes the one at its own time: the one that its name or a list states, as in TUM's
    data sets and EuRoC's, or its time in the video. Where there are no times, or others, the file has one pose for
    every frame, in their order.

    Raises InputError or ResultError for an unreadable file, another number of poses, or a frame without a pose.
    """
    stamps, poses = pose_table(path, quaternion)
    times = None if stamps is None else in_seconds(stamps)
    frames = len(clip.images)
    pairs, wanted = np.zeros((0, 2), int), None
    if times is not None:
        for each in _times(clip):
            found = associate(each, times)
            if wanted is None or len(found) > len(pairs):
                pairs, wanted = found, each
    if len(poses) == frames and len(pairs) < frames:  # by their order
        if len(pairs):
            logger.warning(
                "%s has a pose for every frame, but the times of only %d of %d are those of frames; taken in order",
                path, len(pairs), frames,
            )  # fmt: skip
        return poses
    if times is None or wanted is None:
        raise InputError(f"{path} has {len(poses)} poses and the clip {frames} frames; expected a pose for every frame")
    if len(pairs) < frames:
        frame = int(np.setdiff1d(np.arange(frames), pairs[:, 0])[0])
        apart = np.abs(times - wanted[frame]).min()
        raise InputError(
            f"{path} has {len(poses)} poses and the clip {frames} frames; the pose nearest to frame {frame} is "
            f"{apart:.3g} s away; expected a pose for every frame, or one at its time"
        )
    return poses[pairs[:, 1]]


def checked_known_poses(
    world_from_camera: Float64[np.ndarray, "S 4 4"], frames: int, name: str
) -> Float64[np.ndarray, "S 4 4"]:
    """Return poses with the nearest rotations, as written ones are rounded.

    Raises InputError, which names them, unless they are rigid, one per frame, at least three, and move, and not so far
    from the origin that a result, whose poses are of 32 bits, would lose their motion.
    """
    count = len(world_from_camera)
    if count != frames:
        raise InputError(f"{name} has {count} poses and the clip {frames} frames; expected a pose for every frame")
    if count < _FEWEST:
        raise InputError(f"{name} has {count} poses; expected at least {_FEWEST}: fewer fit any prediction")
    poses = checked_world_from_camera(world_from_camera, name).copy()
    centres = world_from_camera[:, :3, 3]
    path = np.linalg.norm(centres - centres.mean(axis=0))
    if path <= _NO_MOTION * max(np.linalg.norm(centres), _NO_MOTION):
        raise InputError(
            f"the {count} poses of {name} are at one place, {np.round(centres[0], 3).tolist()}; expected cameras that "
            "move: without a distance between them they give no scale"
        )
    if path < _FAR_AWAY * np.linalg.norm(centres):
        raise InputError(
            f"the poses of {name} are at about {np.round(centres.mean(axis=0)).tolist()}, too far from the origin for "
            "their motion; subtract this place from all of them"
        )
    poses[:, :3, :3] = scipy.spatial.transform.Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    return poses


def agreement(camera_from_world: Float64[np.ndarray, "S 3 4"], known: Float64[np.ndarray, "S 3 4"]) -> PoseAgreement:
    """Compare predicted with known poses.

    The worlds are brought together by the mean of the rotations between them; the scale is the median, over all pairs
    of frames, of the known over the predicted distance between their cameras. Raises InputError where the predicted
    cameras do not move.
    """
    between = scipy.spatial.transform.Rotation.from_matrix(known[:, :, :3].swapaxes(1, 2) @ camera_from_world[:, :, :3])
    turn = between.mean()  # of the known world from the predicted one
    angles = np.degrees((turn.inv() * between).magnitude())
    centres, true_centres = camera_centres(camera_from_world), camera_centres(known)
    pairs = np.triu_indices(len(known), 1)
    distances, true_distances = (np.linalg.norm(c[pairs[0]] - c[pairs[1]], axis=1) for c in (centres, true_centres))
    used = (distances > _NO_MOTION * distances.max()) & (true_distances > 0)
    if not used.any() or distances.max() <= 0:
        raise InputError("the predicted cameras do not move; known poses cannot be fitted to them")
    scale = float(np.median(true_distances[used] / distances[used]))
    offsets = scale * turn.apply(centres) - true_centres
    rmse = np.sqrt(((offsets - np.median(offsets, axis=0)) ** 2).sum(axis=1).mean())
    length = np.linalg.norm(np.diff(true_centres, axis=0), axis=1).sum()
    return PoseAgreement(float(np.median(angles)), float(angles.max()), float(rmse / length), scale)


def check_agreement(
    camera_from_world: Float64[np.ndarray, "S 3 4"], known: Float64[np.ndarray, "S 3 4"], name: str
) -> PoseAgreement:
    """Compare predicted with known poses; raises InputError for poses of another clip or in another convention."""
    found = agreement(camera_from_world, known)
    turn = f"{found.turn_median:.0f} degrees (median)"
    words = f"the poses of {name} do not fit: they are turned from the predicted ones by {turn}"
    others = {
        "in OpenGL's axes (y up, z backward)": np.diag([1.0, -1.0, -1.0]) @ known,
        "as camera-from-world": world_from_camera(known)[:, :3],
        "with the quaternion's w first (--quaternion wxyz)": _in_order(known, [1, 2, 3, 0]),
        "with the quaternion's w last (--quaternion xyzw)": _in_order(known, [3, 0, 1, 2]),
    }
    read = {convention: agreement(camera_from_world, poses) for convention, poses in others.items()}
    convention = min(read, key=lambda name: _residual(read[name]))
    if _residual(found) > _RESIDUAL and _residual(read[convention]) < _LESS * _residual(found):
        left, offset = read[convention].turn_median, read[convention].centres
        raise InputError(
            f"{words}, and their centres differ by {found.centres:.0%} of the path; if read {convention}, by "
            f"{left:.1f} degrees and {offset:.0%}; expected world-from-camera poses in OpenCV's axes (x right, y down, "
            "z forward)"
        )
    if found.turn_median > _MOST_TURN:
        raise InputError(
            f"{words}, at most {found.turn_most:.0f}, and their centres differ by {found.centres:.0%} of the path; "
            "expected poses of these frames"
        )
    return found


def _residual(found: PoseAgreement) -> float:
    """Return degrees and hundredths of the path together: a pan misread turns alike about another axis."""
    return found.turn_median + 100 * found.centres


def _in_order(known: Float64[np.ndarray, "S 3 4"], order: list[int]) -> Float64[np.ndarray, "S 3 4"]:
    """Return poses with the numbers of their quaternions x y z w taken in another order, at the same places."""
    turns = scipy.spatial.transform.Rotation.from_matrix(known[:, :, :3]).inv().as_quat()[:, order]
    rotations = scipy.spatial.transform.Rotation.from_quat(turns).as_matrix()
    return world_from_camera(np.concatenate([rotations, camera_centres(known)[:, :, None]], axis=2))[:, :3]


def _times(clip: Clip | Result) -> list[Float64[np.ndarray, " S"]]:
    """Return the times of the frames by the source's clock, and from its first frame; those that are known."""
    if clip.timestamps is None:
        named = name_times(list(clip.frame_names))
        return [] if named is None else [named]
    source = getattr(clip, "source", None)
    times = source.times if isinstance(source, ImageFiles) else None
    if isinstance(clip, Result):
        return [clip.file_times, clip.timestamps]
    return [clip.timestamps] if times is None else [clip.timestamps + float(times.first), clip.timestamps]
