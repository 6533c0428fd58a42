from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vggtjax.clips.media.arrays import ArrayFrames
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.order import in_order
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.media.video import VideoFile
from vggtjax.clips.sources import clips_by_name, open_source
from vggtjax.errors import ClipError


@pytest.fixture
def folder(tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for name in ("frame_10.png", "frame_2.png", "frame_1.JPG", ".frame_0.png", "._frame_1.png"):
        Image.new("RGB", (2, 2)).save(frames / name)
    (frames / "notes.txt").write_text("hidden files and notes are no frames")
    (frames / "frame_3.png").mkdir()
    return frames


def names(source):
    assert isinstance(source, ImageFiles)
    assert all(path.is_absolute() for path in source.paths)
    return [path.name for path in source.paths]


def test_natural_order():
    ordered = ["2", "10", "a1b2", "a1b10", "a02", "a10", "B1"]
    shuffled = [Path(name) for name in ("B1", "a10", "10", "a1b10", "2", "a02", "a1b2")]
    assert [path.name for path in in_order(shuffled)] == ordered
    assert in_order(["cam10/frame_2", "cam2/frame_10"], Path) == ["cam2/frame_10", "cam10/frame_2"]
    in_order([Path("1"), Path("a"), Path("1a"), Path("²"), Path("٣")])  # other digits do not break it


@pytest.mark.parametrize(
    "ordered",
    [
        ["1700000000.05.png", "1700000000.1.png", "1700000000.15.png", "1700000000.2.png", "1700000001.png"],
        ["0.0.jpg", "0.033333.jpg", "0.1.jpg", "0.25.jpg", "9.5.jpg", "10.05.jpg"],
        ["rgb_1305031102.175304.png", "rgb_1305031102.21.png", "rgb_1305031102.3.png"],
        ["t=0.5s.png", "t=0.75s.png", "t=1s.png", "t=1.25s.png"],
        ["1700000000.05", "1700000000.1", "1700000000.15"],  # folders
        ["shot1.8.png", "shot1.9.png", "shot1.10.png", "shot1.11.png"],  # counted on
        ["v1.2.9.png", "v1.2.10.png"],
        ["1.0009.png", "1.0010.png"],
    ],
)
def test_decimal_names_by_value(ordered):
    assert in_order(sorted(ordered, reverse=True), Path) == ordered
    assert [path.name for path in in_order(Path("a2.10") / name for name in sorted(ordered))] == ordered


def test_folder(folder):
    ordered = ["frame_1.JPG", "frame_2.png", "frame_10.png"]
    assert names(open_source(folder)) == ordered
    assert names(open_source(str(folder))) == ordered
    assert names(open_source(f"{folder}/*")) == ordered
    assert names(open_source([folder / "frame_10.png", str(folder / "frame_2.png")])) == [ordered[2], ordered[1]]
    assert names(open_source(f"{folder.parent}/**/frame_*.png")) == ordered[1:]


def test_single_files(folder):
    assert names(open_source(folder / "frame_2.png")) == ["frame_2.png"]
    video = folder / "clip.MP4"
    video.touch()
    assert open_source(video) == VideoFile(video)
    (folder / "frame_2.png").rename(folder / "frame[2].png")  # no pattern
    assert names(open_source(str(folder / "frame[2].png"))) == ["frame[2].png"]
    (folder / "weights.pt").touch()
    with pytest.raises(ClipError, match="name of neither an image nor a video"):
        open_source(folder / "weights.pt")


def test_a_folder_without_images_says_what_it_holds(tmp_path):
    with pytest.raises(ClipError, match="holds no images; name the folder"):
        open_source(tmp_path)
    (tmp_path / "b10").mkdir()
    for name in ("a.mp4", "x.txt", "y.txt"):
        (tmp_path / name).touch()
    with pytest.raises(ClipError, match=r"1 folder \(b10\) and 1 video \(a.mp4\) and 2 other files \(x.txt, y.txt\)"):
        open_source(tmp_path)
    with pytest.raises(ClipError, match=r"matches no images, but 1 video \(a.mp4\)"):
        open_source(f"{tmp_path}/*.mp4")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("missing/frames", "'missing/frames' does not exist"),
        ("https://example.org/clip.mp4?x=1", r"https://example.org/clip.mp4\?x=1 is a URL; download the file first"),
        ("x" * 5000, "cannot read x+.*: File name too long"),
        (["missing.png"], "image missing.png does not exist"),
        (["a.png", np.zeros((1, 1, 3))], "holds ndarray, str; expected image paths only, or arrays only"),
        ("/dev/null", "is a pipe, a socket or a device; expected a file"),
    ],
)
def test_sources_that_are_none(source, message):
    with pytest.raises(ClipError, match=message):
        open_source(source)


def test_a_pattern_with_a_number_in_c_is_a_pattern(tmp_path):
    for name in ("img0001", "img0002", "img10000", "img3", "img0004_depth", "other0001"):
        Image.new("RGB", (8, 8)).save(tmp_path / f"{name}.png")
    for pattern, names in (
        ("img%04d.png", ["img0001", "img0002", "img10000"]),
        ("img%d.png", ["img0001", "img0002", "img3", "img10000"]),
    ):
        assert [frame.name for frame in open_source(str(tmp_path / pattern)).frames(Sampling())] == names
    with pytest.raises(ClipError, match=r"pattern .*img%06d\.png matches no images"):
        open_source(str(tmp_path / "img%06d.png"))


def test_a_list_of_pil_images_is_read_like_their_files():
    transparent = Image.new("RGBA", (28, 14), (255, 0, 0, 0))
    frames = list(open_source([transparent, Image.new("L", (28, 14), 7)]).frames(Sampling()))
    assert [frame.image.getpixel((0, 0)) for frame in frames] == [(255, 255, 255), (7, 7, 7)]
    arrays = np.zeros((2, 4, 5, 3), np.uint8)
    assert all(isinstance(open_source(given), ArrayFrames) for given in (arrays, list(arrays), tuple(arrays)))


def test_links_are_named_as_they_are(tmp_path, monkeypatch):
    for name in ("x/rgb", "y/rgb"):
        (tmp_path / name).mkdir(parents=True)
        for number in (0, 1):
            Image.new("RGB", (28, 14)).save(tmp_path / name / f"{number}.png")
    video = tmp_path / "x/video.mp4"
    video.write_bytes(b"x")
    links = tmp_path / "links"
    links.mkdir()
    for name, target in (("a", "x/rgb"), ("b", "y/rgb"), ("c.mp4", "x/video.mp4"), ("d", "a")):
        (links / name).symlink_to(tmp_path / target if "/" in target else links / target)
    assert list(clips_by_name([str(links)])) == ["a", "b", "c", "d"]
    assert list(clips_by_name([str(links / "b"), f"{links}/a/"])) == ["b", "a"]
    assert open_source(links / "a").name == "a"
    monkeypatch.chdir(tmp_path / "x/rgb")
    assert list(clips_by_name(["."])) == ["rgb"]
