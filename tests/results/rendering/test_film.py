import av
import numpy as np
import pytest
from PIL import Image

from vggtjax.errors import InputError
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
