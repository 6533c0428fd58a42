"""What users send: checked by number, name, size and content before a model is loaded."""

import numpy as np
import pytest
from PIL import Image

from tests.shared.videos import write_video
from vggtjax.errors import ClipError, InputError
from vggtjax.interface.app.limits import Limits
from vggtjax.interface.app.uploads import checked_clip


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["a.txt"], "a.txt: by its name this is no video and no picture"),
        (["b.png", "capture.zip"], "capture.zip: by its name this is no video and no picture"),
        (["a.mp4", "b.png"], "2 files were sent; send one video, or at most 1000 pictures"),
        (["a.mp4"], "cannot read video"),
        (["b.png"], "b.png"),
        (["gone.png"], "gone.png: the upload is not here any more"),
        (["b.png", "gone.mov"], "gone.mov: the upload is not here any more"),
        (["folder.jpg"], "folder.jpg: the upload is not here any more"),
        (["b.png"] * 1001, "1001 files were sent; send one video, or at most 1000 pictures"),
        (["large.png", "large.png"], r"the upload has 1\.2 MB; send at most 1 MB"),
    ],
)
def test_an_upload_that_is_no_clip_is_refused(tmp_path, names, said):
    for name, content in (("a.txt", b"words"), ("a.mp4", b"words"), ("b.png", b""), ("capture.zip", b"PK")):
        (tmp_path / name).write_bytes(content)
    (tmp_path / "large.png").write_bytes(bytes(600_000))
    (tmp_path / "folder.jpg").mkdir()
    with pytest.raises(ClipError, match=said):
        checked_clip([tmp_path / name for name in names], 8, 0, Limits(max_upload_mb=1))


def test_a_long_video_is_refused_and_a_short_one_is_sampled_evenly(tmp_path):
    video = write_video(tmp_path / "a.mp4", range(0, 4000, 250))
    with pytest.raises(ClipError, match="the video is 4 s long; send at most 3 s"):
        checked_clip([video], 8, 0, Limits(max_seconds=3))
    for rate, times in ((0, [0, 1, 2, 3]), (2.0, [0, 0.5, 1, 1.5])):
        source, sampling = checked_clip([video], 4, rate, Limits(max_seconds=4))
        assert [frame.time for frame in source.frames(sampling)] == times


def test_pictures_are_taken_in_the_order_of_their_names(tmp_path):
    paths = [tmp_path / f"frame {number}.png" for number in range(11)]
    for number, path in enumerate(paths):
        Image.new("RGB", (28, 28), (20 * number, 0, 0)).save(path)
    source, sampling = checked_clip(sorted(paths), 4, 7.0, Limits())  # "frame 10" before "frame 2"
    assert [np.asarray(frame.image)[0, 0, 0] for frame in source.frames(sampling)] == [0, 60, 120, 180]


@pytest.mark.parametrize("name", ["max_upload_mb", "max_seconds", "max_frames", "max_waiting"])
def test_a_limit_below_one_is_refused(name):
    assert getattr(Limits(**{name: 1}), name) == 1
    with pytest.raises(InputError, match=f"{name} is 0"):
        Limits(**{name: 0})
