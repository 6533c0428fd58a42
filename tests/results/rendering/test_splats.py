import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vggtjax.cameras import Cameras
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
    splats = Splats(
        positions.astype(np.float32),
        random.integers(0, 256, (count, 3)).astype(np.uint8),
        (random.random(count) ** 2).astype(np.float32),
    )
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
