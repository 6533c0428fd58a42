import av
import numpy as np
import pytest
from PIL import Image

from tests.shared.room import make_room
from vggtjax.errors import InputError
from vggtjax.results.films import due_frames, film_frames
from vggtjax.results.rendering.film import write_film


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
