"""Films: points drawn as splats, the paths of the camera, frames of a result, files of every kind."""

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.shared.room import make_room
from vggtjax.cameras import Cameras, camera_centres
from vggtjax.errors import InputError
from vggtjax.results.films import due_frames, film_frames
from vggtjax.results.rendering.film import write_film
from vggtjax.results.rendering.paths import fitted_intrinsics, follow, middle_camera, orbit
from vggtjax.results.rendering.splats import BACKGROUND, Splats, draw_splats, pixel_radii, project


def frames(count=6, height=40, width=60):
    for number in range(count):
        frame = np.full((height, width, 3), (30, 60, 90), np.uint8)
        frame[8:24, 8 * number : 8 * number + 12] = (250, 40, 30)
        yield frame


def read(path):
    if path.suffix == ".mp4":
        with av.open(str(path)) as container:
            return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    with Image.open(path) as film:
        shown = []
        for number in range(getattr(film, "n_frames", 1)):
            film.seek(number)
            shown.append(np.asarray(film.convert("RGB")))
    return shown


@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "film.WEBP"])
def test_films_show_their_frames(tmp_path, name):
    write_film(tmp_path / name, frames(), 12)
    shown = read(tmp_path / name)
    assert len(shown) == 6
    for got, expected in zip(shown, frames(), strict=True):
        assert np.abs(got.astype(int) - expected).mean() < 4
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_an_mp4_has_even_sides_and_its_rate(tmp_path):
    write_film(tmp_path / "film.mp4", frames(height=41, width=61), 12.5)
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.pix_fmt) == (60, 40, "yuv420p")
        assert stream.average_rate == 12.5


def test_a_gif_keeps_time_and_repeats(tmp_path):
    write_film(tmp_path / "film.gif", frames(), 24)
    with Image.open(tmp_path / "film.gif") as film:
        times = []
        for number in range(6):
            film.seek(number)
            times.append(film.info["duration"])
        assert film.info["loop"] == 0
    assert sum(times) == 250
    assert set(times) == {40, 50}


def test_bad_films(tmp_path):
    for name, shown, fps, message in (
        ("film.mp4", frames(), 0, "fps is 0; expected a number above 0, at most 120"),
        ("film.mp4", [*frames(1), *frames(1, 20)], 12, "all of one size"),
    ):
        with pytest.raises(InputError, match=message):
            write_film(tmp_path / name, shown, fps)
        assert list(tmp_path.iterdir()) == []


RED = np.array([220, 40, 30])


@pytest.fixture(scope="module")
def room():
    return make_room(frames=4, height=56, width=84)


def film(room, **options):
    return list(film_frames(room, **({"size": (84, 56), "fps": 4, "seconds": 1} | options)))


def red(picture):
    return (np.abs(picture.astype(int) - RED).max(axis=-1) < 30).nonzero()[1]


def test_moving_points_play_and_static_ones_stay():
    still = np.tile(make_room(1, 56, 84).camera_from_world, (4, 1, 1))
    depth, mask = np.full((4, 56, 84), 5, np.float32), np.zeros((4, 56, 84), bool)
    images = np.full((4, 56, 84, 3), 90, np.uint8)
    for frame in range(4):
        place = np.s_[frame, 20:36, 20 * frame : 20 * frame + 12]
        depth[place], mask[place], images[place] = 3, True, RED
    room = make_room(4, 56, 84, depth=depth, dynamic_mask=mask, images=images, camera_from_world=still)
    pictures = film(room, path="camera")
    middles = [red(picture).mean() for picture in pictures]
    assert (np.diff(middles) > 5).all()
    for picture in pictures:
        assert (picture[28, 8:-8].min(axis=-1) > 25).all()  # behind the box is the wall of other frames


def test_frames_that_are_due(room):
    assert due_frames(room, 1.0, 8, loops=False).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    times = make_room(4, timestamps=np.arange(4) / 8)
    assert due_frames(times, 1.0, 16, loops=True).tolist() == [0, 0, 1, 1, 2, 2, 3, 3] * 2
    assert due_frames(times, 1.0, 4, loops=True).tolist() == [0, 1, 2, 3]  # no time to show all of them twice
    assert due_frames(make_room(4, timestamps=None), 1.2, 12, loops=True).tolist() == [0, 1, 2, 3] * 3
    assert due_frames(make_room(1), 1.0, 3, loops=True).tolist() == [0, 0, 0]


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
