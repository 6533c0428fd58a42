"""The fingerprint of a source: another one where its frames are others, the same for a copy, none where it is gone."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from tests.shared.videos import write_video
from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.fingerprint import fingerprint, source_setting
from vggtjax.clips.media.animation import Animation
from vggtjax.clips.media.arrays import ArrayFrames
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.video import VideoFile
from vggtjax.clips.sources import open_source

FISHEYE = {"fl_x": 20, "cx": 14, "cy": 14, "w": 28, "h": 28, "camera_model": "OPENCV_FISHEYE", "k1": 0.05}


def pictures(folder, last):
    """Write two grey pictures, of which the last one may differ."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in (("0.png", 10), ("1.png", last)):
        Image.new("RGB", (28, 28), (value,) * 3).save(folder / name)
    return folder


def video(folder, last):
    folder.mkdir(exist_ok=True)
    return write_video(folder / "a.mp4", (10, last))


def animation(folder, last):
    folder.mkdir(exist_ok=True)
    frames = [Image.new("RGB", (28, 28), (value,) * 3) for value in (10, last)]
    frames[0].save(folder / "a.png", save_all=True, append_images=frames[1:])
    return folder / "a.png"


def capture(folder, last):
    """Write a capture of a lens that no pinhole stands for."""
    pictures(folder / "images", last)
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(2)]
    (folder / "transforms.json").write_text(json.dumps(FISHEYE | {"frames": frames}))
    return folder


WRITERS = {
    "folder": (pictures, ImageFiles),
    "video": (video, VideoFile),
    "animation": (animation, Animation),
    "capture": (capture, CaptureFrames),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_files(tmp_path, kind):
    write, expected = WRITERS[kind]
    source = write(tmp_path / "a", 20)
    opened = open_source(source, undistort=None)
    assert type(opened) is expected
    known = fingerprint(opened)
    assert source_setting(opened) == {"source": known}
    copy = shutil.copytree(tmp_path / "a", tmp_path / "b", copy_function=shutil.copyfile)  # with dates of its own
    assert fingerprint(open_source(copy if source.is_dir() else copy / source.name, undistort=None)) == known
    write(tmp_path / "a", 90)
    assert fingerprint(opened) not in (None, known)
    shutil.rmtree(tmp_path / "a")
    assert fingerprint(opened) is None
    assert source_setting(opened) == {}


def test_arrays():
    frames = np.full((2, 28, 28, 3), 10, np.uint8)
    known = fingerprint(ArrayFrames.from_arrays(frames))
    assert known == fingerprint(ArrayFrames.from_arrays(list(frames.copy())))
    for other in (frames.reshape(2, 14, 56, 3), frames.astype(np.uint16) * 257, frames[:1], frames + np.uint8(1)):
        assert fingerprint(ArrayFrames.from_arrays(other)) not in (None, known)


def test_a_source_without_a_path_has_none():
    class Frames:
        name = "of a program"

    assert fingerprint(Frames()) is None  # type: ignore[arg-type]
