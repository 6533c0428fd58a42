import numpy as np
import pytest

from tests.shared.room import make_room
from vggtjax.cameras import Cameras, camera_centres
from vggtjax.results.rendering.paths import fitted_intrinsics, follow, middle_camera, orbit


@pytest.fixture(scope="module")
def real():
    room = make_room(frames=9)
    return Cameras(room.camera_from_world, room.intrinsics)


def test_the_orbit_looks_at_the_middle_and_closes(real):
    intrinsics = fitted_intrinsics(real, (42, 28), (96, 54))
    focal = 0.9 * 42 * 54 / 28  # all that is filmed fits
    np.testing.assert_allclose(intrinsics, [[focal, 0, 48], [0, focal, 27], [0, 0, 1]], rtol=1e-6)
    path = orbit(real, intrinsics, 4.0, 48)
    middle = middle_camera(real)
    pose = real.camera_from_world[middle].astype(np.float64)
    pivot = pose[:, :3].T @ (np.array([0, 0, 4]) - pose[:, 3])
    seen = path.camera_from_world[:, :, :3] @ pivot + path.camera_from_world[:, :, 3]
    np.testing.assert_allclose(seen, np.tile([0, 0, 1.4 * 4], (48, 1)), atol=1e-5)
    centres = camera_centres(path.camera_from_world)
    steps = np.linalg.norm(centres - np.roll(centres, 1, axis=0), axis=-1)
    assert steps.max() < 2 * np.median(steps)  # no jump, from the last to the first neither
    assert np.linalg.norm(centres - centres.mean(axis=0), axis=-1).max() < 3


def test_a_camera_that_stands_still_is_followed_from_behind(real):
    still = Cameras(np.tile(real.camera_from_world[:1], (5, 1, 1)), real.intrinsics[:5])
    for cameras in (still, Cameras(still.camera_from_world[:1], still.intrinsics[:1])):
        path = follow(cameras, np.eye(3), 4.0, 7)
        expected = still.camera_from_world[0] + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0.6]])
        np.testing.assert_allclose(path.camera_from_world, np.tile(expected, (7, 1, 1)), atol=1e-6)


def test_the_followed_path_is_near_the_real_one_and_smooth(real):
    path = follow(real, np.eye(3), 0.0, 33)
    centres, real_centres = camera_centres(path.camera_from_world), camera_centres(real.camera_from_world)
    assert np.linalg.norm(centres[::4] - real_centres, axis=-1).max() < 0.15
    rotation = path.camera_from_world[:, :, :3]
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), np.tile(np.eye(3), (33, 1, 1)), atol=1e-9)
