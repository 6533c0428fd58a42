"""Paths of virtual cameras: one that swings around the middle of a scene, and one that follows the real cameras."""

from __future__ import annotations

import numpy as np
import scipy
from jaxtyping import Float

from vggtjax.cameras import Cameras, camera_centres, world_from_camera

SWING, NOD = 24.0, 2.0  # degrees to either side, and up and down: behind what was filmed there is nothing
_LIFT = 3.0  # degrees by which the swing's middle is above the cameras
_BACK = 0.4  # of the distance to the scene's middle: how far the swinging camera stands behind the real ones
_FOLLOW_BACK = 0.15  # the same for the one that follows
_SMOOTH = 0.03  # of the clip: standard deviation of the smoothing of the followed path


def fitted_intrinsics(cameras: Cameras, source: tuple[int, int], size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """Return intrinsics of a picture of this size that shows all that the median camera sees.

    Args:
        cameras: the real ones, of pictures of `source`.
        source: width and height of the real pictures.
        size: width and height of the virtual ones.
    """
    focal = np.median(np.asarray(cameras.intrinsics, np.float64)[:, [0, 1], [0, 1]], axis=0)
    scale = (np.array(size) / source * focal).min()
    return np.array([[scale, 0, size[0] / 2], [0, scale, size[1] / 2], [0, 0, 1]])


def middle_camera(cameras: Cameras) -> int:
    """Return the real camera that stands nearest to the median place of all."""
    centres = camera_centres(np.asarray(cameras.camera_from_world, np.float64))  # squares of far places are finite
    return int(np.linalg.norm(centres - np.median(centres, axis=0), axis=-1).argmin())


def orbit(cameras: Cameras, intrinsics: Float[np.ndarray, "3 3"], depth: float, count: int) -> Cameras:
    """Swing once to both sides around the point at `depth` before the middle camera, and return to the start.

    Args:
        cameras: the real ones.
        intrinsics: of the virtual ones.
        depth: of the scene's middle, in the middle camera.
        count: of virtual cameras; the one after the last would be the first.
    """
    start = world_from_camera(np.asarray(cameras.camera_from_world, np.float64)[[middle_camera(cameras)]])[0]
    turns = 2 * np.pi * np.arange(count) / count
    yaw, pitch = SWING * np.sin(turns), -_LIFT - NOD * np.sin(2 * turns + np.pi / 2)
    angles = np.stack([yaw, pitch], axis=-1)
    swing = scipy.spatial.transform.Rotation.from_euler("yx", angles, degrees=True).as_matrix()
    rotations = start[:3, :3] @ swing
    pivot = start[:3, 3] + depth * start[:3, 2]
    return _placed(rotations, pivot - (1 + _BACK) * depth * rotations[:, :, 2], intrinsics)


def follow(cameras: Cameras, intrinsics: Float[np.ndarray, "3 3"], depth: float, count: int) -> Cameras:
    """Follow the real cameras from the first to the last, smoothed and a little behind them.

    Arguments as for `orbit`; the real cameras are in the order of time.
    """
    real = world_from_camera(np.asarray(cameras.camera_from_world, np.float64))
    frames = len(real)
    turned = scipy.spatial.transform.Rotation.from_matrix(real[:, :3, :3])
    if frames == 1:
        rotations, centres = np.tile(real[:, :3, :3], (count, 1, 1)), np.tile(real[:, :3, 3], (count, 1))
    else:
        times = np.linspace(0, frames - 1, count)
        spread = max(_SMOOTH * frames, 0.5) * (count - 1) / (frames - 1)
        steps = np.arange(frames)
        rotations = scipy.spatial.transform.Slerp(steps, turned)(times).as_matrix()
        centres = np.stack([np.interp(times, steps, real[:, axis, 3]) for axis in range(3)], axis=-1)
        rotations, centres = (
            scipy.ndimage.gaussian_filter1d(value, spread, axis=0, mode="nearest") for value in (rotations, centres)
        )
        # The nearest rotation of a mean of matrices.
        rotations = scipy.spatial.transform.Rotation.from_matrix(rotations).as_matrix()
    return _placed(rotations, centres - _FOLLOW_BACK * depth * rotations[:, :, 2], intrinsics)


def _placed(rotations: np.ndarray, centres: np.ndarray, intrinsics: Float[np.ndarray, "3 3"]) -> Cameras:
    poses = np.concatenate([rotations, centres[:, :, None]], axis=2)  # world-from-camera
    return Cameras(world_from_camera(poses)[:, :3], np.tile(intrinsics, (len(poses), 1, 1)))
