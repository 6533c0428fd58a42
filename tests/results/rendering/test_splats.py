import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared.room import make_room
from vggtjax.cameras import Cameras, camera_centres
from vggtjax.results.rendering.paths import fitted_intrinsics, follow, middle_camera, orbit
from vggtjax.results.rendering.splats import BACKGROUND, Splats, draw_splats, pixel_radii, project

FRONT = np.eye(4)[:3]


def camera(width, height, focal=10.0):
    return Cameras(FRONT, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]))


def drawn_slowly(splats, view, size, supersampling=1):
    """Draw point by point and pixel by pixel."""
    width, height = size[0] * supersampling, size[1] * supersampling
    intrinsics = np.asarray(view.intrinsics, np.float32) * np.array([[supersampling], [supersampling], [1]], np.float32)
    x, y, depth = project(splats.positions, view.camera_from_world, intrinsics)
    picture = np.full((height, width, 3), BACKGROUND, np.uint8)
    nearest = np.full((height, width), np.inf)
    for point in range(len(depth)):
        if not (depth[point] > 0 and 0 <= x[point] < width and 0 <= y[point] < height):
            continue
        one = slice(point, point + 1)
        radius = int(pixel_radii(splats.diameters[one], depth[one], float(intrinsics[0, 0]))[0])
        for row in range(height):
            for column in range(width):
                right, down = column - int(x[point]), row - int(y[point])
                if right**2 + down**2 <= (radius + 0.5) ** 2 and depth[point] <= nearest[row, column]:
                    nearest[row, column] = depth[point]
                    picture[row, column] = splats.colors[point]
    parts = picture.reshape(size[1], supersampling, size[0], supersampling, 3).astype(float)
    return np.floor(parts.mean(axis=(1, 3)) + 0.5).astype(np.uint8)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(0, 25), st.sampled_from([1, 2, 3]), st.integers(3, 9), st.integers(3, 9))
def test_equals_a_loop_over_points_and_pixels(seed, count, supersampling, width, height):
    random = np.random.default_rng(seed)
    positions = random.normal(size=(count, 3)) * [1, 1, 2] + [0, 0, 2]
    positions[:, 2] = np.where(random.random(count) < 0.3, 2, positions[:, 2])  # equally far
    colors, diameters = random.integers(0, 256, (count, 3)).astype(np.uint8), random.random(count) ** 2
    splats = Splats(positions.astype(np.float32), colors, diameters.astype(np.float32))
    view = camera(width, height)
    picture = draw_splats(splats, view, (width, height), supersampling=supersampling)
    np.testing.assert_array_equal(picture, drawn_slowly(splats, view, (width, height), supersampling))


def test_a_wall_at_its_own_spacing_has_no_holes():
    rows, columns = np.mgrid[-20:20, -20:20]
    positions = np.stack([columns / 10, rows / 10, np.full(rows.shape, 2.0)], axis=-1).reshape(-1, 3)
    splats = Splats(positions.astype(np.float32), np.full((1600, 3), 255, np.uint8), np.full(1600, 0.1415, np.float32))
    for focal in (12.0, 20.0, 63.0, 150.0):
        assert (draw_splats(splats, camera(20, 20, focal), (20, 20)) == 255).all()


def test_points_behind_too_near_or_broken_are_not_drawn():
    positions = np.array([[0, 0, -1], [0, 0, 0], [np.nan, 0, 1], [0, np.inf, 1], [0, 0, 0.5]], np.float32)
    splats = Splats(positions, np.full((5, 3), 255, np.uint8), np.ones(5, np.float32))
    assert (draw_splats(splats, camera(8, 8), (8, 8), near=0.5) == BACKGROUND).all()


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
