"""Times of frames: in names, in lists, and what only looks like them."""

from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vggtjax import load_clip
from vggtjax.media.images import stated_times
from vggtjax.media.sampling import Sampling
from vggtjax.media.times import in_seconds

EUROC = ["1403636579763555584", "1403636579813555456", "1403636579863555584"]
SECONDS = [Decimal("1403636579.763555584"), Decimal("1403636579.813555456"), Decimal("1403636579.863555584")]


def frames(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("RGB", (28, 28)).save(folder / f"{name}.png")
    return [folder / f"{name}.png" for name in names]


@pytest.mark.parametrize(
    ("names", "seconds", "unit"),
    [
        (EUROC, SECONDS, "nanoseconds"),
        ([f"cam0_{name}" for name in EUROC], SECONDS, "nanoseconds"),
        ([f"frame_{number:04d}_{name}_left" for number, name in enumerate(EUROC)], SECONDS, "nanoseconds"),
        (["1700000000123456", "1700000000156789"], ["1700000000.123456", "1700000000.156789"], "microseconds"),
        (["img1700000000123", "img1700000000157"], ["1700000000.123", "1700000000.157"], "milliseconds"),
        (["1700000000", "1700000001"], ["1700000000", "1700000001"], "seconds"),
        (["1305031102.175304", "1305031102.3"], ["1305031102.175304", "1305031102.3"], "seconds"),
        (["rgb-1305031102.175304", "rgb-1305031102.211"], ["1305031102.175304", "1305031102.211"], "seconds"),
        (["0.033", "0.067"], ["0.033", "0.067"], "seconds"),
    ],
)
def test_names_tell_seconds_by_their_digits(names, seconds, unit):
    found = stated_times([Path("nowhere") / f"{name}.png" for name in names])
    assert found.seconds == tuple(map(Decimal, seconds))
    assert found.origin == f"the names of the frames, in {unit}"


@pytest.mark.parametrize(
    "names",
    [
        ["000001", "000002"],
        ["0000000005", "0000000006"],  # ten digits, of a counter
        ["IMG_1234", "IMG_1235"],
        ["20240102_123456", "20240102_123457"],  # dates
        ["20240102123456", "20240102123457"],
        ["2024010212345678", "2024010212345699"],
        ["1403636579763555584"] * 2,  # constant
        EUROC[::-1],  # backwards
        [EUROC[0], "1700000000123"],  # of two units
        ["1700000000123", "1800000000123"],  # years apart
        ["shot2.0001", "shot2.0002"],
        ["1403636579763555584_1403636579813555456", "1403636579863555584_1403636579913555456"],
    ],
)
def test_names_that_are_no_times(names):
    assert stated_times([Path("nowhere") / f"{name}.png" for name in names]) is None


@pytest.mark.parametrize(
    ("file", "text", "seconds"),
    [
        ("timestamps.txt", "0.0\n0.05\n0.125\n", ["0", "0.05", "0.125"]),
        ("timestamps.txt", "# ms\n0\n33\n67\n", ["0", "0.033", "0.067"]),
        ("../timestamps.txt", "\n".join(EUROC), SECONDS),
        ("times.txt", "1.403636579763555584e+18\n1.403636579813555456e+18\n1.403636579863555584e+18", SECONDS),
        ("timestamps.txt", "b.png 2.5\na.png 1.5\nc.png 4\n", ["1.5", "2.5", "4"]),
        ("timestamps.txt", "1.5 a\n2.5 b\n4 c\n9 unused\n", ["1.5", "2.5", "4"]),
        ("../data.csv", "#timestamp [ns],filename\n" + "".join(f"{time},{name}.png\r\n" for time, name in
                                                              zip(EUROC, "abc", strict=True)), SECONDS),
        ("data.csv", "timestamp [us],filename\n0,data/a.png\n7,data/b.png\n9,data/c.png\n",
         ["0", "0.000007", "0.000009"]),
        ("../timestamps.txt", "".join(f"2011-09-26 13:02:25.{digit}64360375\n" for digit in (1, 5, 9)),
         [f"1317042145.{digit}64360375" for digit in (1, 5, 9)]),
    ],
)  # fmt: skip
def test_lists_beside_and_above_the_frames(tmp_path, file, text, seconds):
    paths = frames(tmp_path / "cam0/data", "abc")
    (tmp_path / "cam0/data" / file).write_text(text)
    found = stated_times(paths)
    assert found.seconds == tuple(map(Decimal, seconds))
    assert found.origin.startswith(Path(file).name)
    assert stated_times(paths[1:]).seconds == found.seconds[1:]  # also of some frames


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("timestamps.txt", "0\n1\n"),  # of two frames
        ("timestamps.txt", "2\n1\n3\n"),  # backwards
        ("timestamps.txt", "a.png 1\nb.png 2\n"),  # without one
        ("data.csv", "name,label\na,cat\nb,dog\nc,cat\n"),
        ("times.txt", "\0\0\0 not a list"),
    ],
)
def test_lists_of_something_else_tell_nothing(tmp_path, file, text):
    paths = frames(tmp_path / "data", "abc")
    (tmp_path / "data" / file).write_text(text)
    assert stated_times(paths) is None


def test_a_clip_has_the_times_of_its_frames(tmp_path):
    frames(tmp_path, EUROC)
    clip = load_clip(tmp_path, size=28)
    np.testing.assert_allclose(clip.timestamps, [0, 0.049999872, 0.1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(load_clip(tmp_path, size=28, start=1).timestamps, [0.049999872, 0.1], rtol=0, atol=1e-12)
    assert load_clip(tmp_path, size=28, fps=10).frame_names == EUROC[::2]
    assert clip.source.total(Sampling(fps=10)) == 2
    (tmp_path / f"{EUROC[1]}.png").rename(tmp_path / "1.png")
    assert load_clip(tmp_path, size=28).timestamps is None


def test_other_units_become_seconds():
    for factor in (1, 1e3, 1e6, 1e9):
        times = factor * np.array([1700000000.25, 1700000001.5])
        np.testing.assert_allclose(in_seconds(times), [1700000000.25, 1700000001.5], rtol=1e-12)
    np.testing.assert_array_equal(in_seconds(np.array([0, 33.0])), [0, 33])
