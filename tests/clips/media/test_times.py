from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from vggtjax import load_clip
from vggtjax.clips.media.images import stated_times
from vggtjax.clips.media.sampling import Sampling

told: Any = stated_times  # of no type: a test knows where there are times
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
        (["1403636579_763555584", "1403636579_813555456"], SECONDS[:2], "seconds"),  # as ROS has them
        (["left-1700000000-000000009", "left-1700000001-000000000"], ["1700000000.000000009", "1700000001"], "seconds"),
    ],
)
def test_names_tell_seconds_by_their_digits(names, seconds, unit):
    found = told([Path("nowhere") / f"{name}.png" for name in names])
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
        ["1403636579_76355558", "1403636580_8135554"],  # nanoseconds without their zeros, or what?
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
        ("data.csv", "#timestamp [ns],filename,exposure [s]\n" + "".join(f"{time},{name}.png,0.01\n" for time, name in
                                                                        zip(EUROC, "abc", strict=True)), SECONDS),
        ("data.csv", "exposure [s],filename,timestamp [ms]\n1,a,5\n2,b,7\n3,c,8\n", ["0.005", "0.007", "0.008"]),
        ("data.csv", "frame,timestamp,filename\n0,0.5,a.png\n1,0.75,b.png\n2,1.5,c.png\n", ["0.5", "0.75", "1.5"]),
        ("TimeStamps.TXT", "0 0.5 a.png\n1 0.75 b.png\n2 1.5 c.png\n", ["0.5", "0.75", "1.5"]),
        ("../timestamps.csv", "file;time\n\"a.png\";0.5\nb.png;0.75\nc.png;1.5\n", ["0.5", "0.75", "1.5"]),
        ("timestamp.txt", "time\n0.5\n0.75\n1.5\n", ["0.5", "0.75", "1.5"]),
        ("times.txt", "0.0\n8.33\n16.67\n", ["0", "0.00833", "0.01667"]),  # milliseconds of 120 frames a second
        ("times.txt", "0.0 a\n4.17 b\n8.33 c\n", ["0", "0.00417", "0.00833"]),
        ("times.txt", "0.0\n3.25\n11.5\n", ["0", "3.25", "11.5"]),  # seconds of keyframes
        ("times.txt", "2011-09-26T13:02:25.96Z a\n2011-09-26T15:02:26+02:00 b\n2011-09-26T13:02:27 c\n",
         ["1317042145.96", "1317042146", "1317042147"]),
        ("../timestamps.txt", "".join(f"2011-09-26 13:02:25.{digit}64360375\n" for digit in (1, 5, 9)),
         [f"1317042145.{digit}64360375" for digit in (1, 5, 9)]),
    ],
)  # fmt: skip
def test_lists_beside_and_above_the_frames(tmp_path, file, text, seconds):
    paths = frames(tmp_path / "cam0/data", "abc")
    (tmp_path / "cam0/data" / file).write_text(text)
    found, later = told(paths), told(paths[1:])
    assert found.seconds == tuple(map(Decimal, seconds))
    assert found.origin.startswith(Path(file).name)
    assert later.seconds == found.seconds[1:]


@pytest.mark.parametrize(
    ("names", "text", "seconds"),
    [
        (["000000", "000001"], "0 10.0\n1 10.1\n", ["10.0", "10.1"]),  # by the number
        (["000005", "000010"], "5 0\n10 33\n", ["0", "0.033"]),
        (["my walk 1", "my walk 2"], "0.5 my walk 1.png\n0.75 my walk 2.png\n", ["0.5", "0.75"]),
        (["a b", "c"], "a b.png 0.5\nc.png 0.75\n", ["0.5", "0.75"]),
        (EUROC[:2], "".join(f"{time},{time}.png,0.{time}\n" for time in EUROC), SECONDS[:2]),  # the last is no time
    ],
)
def test_rows_are_found_by_number_and_by_names_with_blanks(tmp_path, names, text, seconds):
    paths = frames(tmp_path, names)
    (tmp_path / "data.csv").write_text(text)
    assert told(paths).seconds == tuple(map(Decimal, seconds))


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("timestamps.txt", "0\n1\n", "it has 2 times for 3 pictures"),
        ("timestamps.txt", "time\n0\n1\n2\n3\n", "it has 4 times for 3 pictures"),
        ("timestamps.txt", "2\n1\n3\n", "it gives 'b.png' no later time than the frame before"),
        ("timestamps.txt", "a.png 1\nb.png 2\n", "it names no 'c.png'"),
        ("timestamps.csv", "file;time\na.png;1\nb.png;then\nc.png;3\n", "its row 2 has 'then'; expected a time"),
        ("times.txt", "\0\0\0 not a list", "its row 1 has"),
        ("times.txt", "# nothing\n", "it has no line with a time"),
        ("data.csv", "name,x,y\na,1.5,2\nb,2.5,1\nc,3.5,2\n", "none of its columns is headed as times"),
        ("data.csv", "name,label\na,cat\nb,dog\nc,cat\n", ""),  # of something else
    ],
)
def test_lists_that_tell_nothing_say_why(tmp_path, caplog, file, text, reason):
    paths = frames(tmp_path / "data", "abc")
    (tmp_path / "data" / file).write_text(text)
    assert stated_times(paths) is None
    assert len(caplog.messages) == bool(reason)
    assert not reason or f"{file} is not used: {reason}" in caplog.text


def test_a_clip_has_the_times_of_its_frames(tmp_path):
    frames(tmp_path, EUROC)
    clip = load_clip(tmp_path, size=28)
    np.testing.assert_allclose(np.asarray(clip.timestamps), [0, 0.049999872, 0.1], rtol=0, atol=1e-12)
    later = np.asarray(load_clip(tmp_path, size=28, start=1).timestamps)
    np.testing.assert_allclose(later, [0.049999872, 0.1], rtol=0, atol=1e-12)
    assert load_clip(tmp_path, size=28, fps=10).frame_names == EUROC[::2]
    assert clip.source.total(Sampling(fps=10)) == 2
    (tmp_path / f"{EUROC[1]}.png").rename(tmp_path / "1.png")
    assert load_clip(tmp_path, size=28).timestamps is None
