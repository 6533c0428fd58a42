"""Folders as people have them: photos of phones, depth maps and masks beside frames, files that are no frames."""

import logging
from typing import Any

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from tests.shared.dataset_files import png, write
from vggtjax import load_clip
from vggtjax.clips.media.animation import Animation
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError

SIZE = (64, 32)
RED, BLUE = (200, 40, 40), (40, 40, 200)


def picture(path, colour=RED, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    saved(path, Image.new("RGB", SIZE, colour), **options)
    return path


def folder(place, *names):
    for name in names:
        picture(place / name)
    return place


def saved(path, image, *others, **options):
    """Write HEIF without the library's plugin for Pillow, which would also read it."""
    if path.suffix.lower() not in (".heic", ".heif", ".hif"):
        image.save(path, **options, **({"save_all": True, "append_images": others} if others else {}))
        return
    file = pillow_heif.from_pillow(image)
    for other in others:
        file.add_from_pillow(other)
    file.save(path, **options)


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags.tobytes()


# Where the quarter that is red in the upper left is shown, by EXIF's orientation.
CORNERS = {1: (0, 0), 3: (1, 1), 6: (1, 0), 8: (0, 1)}


@pytest.mark.parametrize("orientation", CORNERS)
@pytest.mark.parametrize("ending", ["heic", "HIF", "avif", "jpg"])
def test_photos_are_upright(tmp_path, ending, orientation):
    image = Image.new("RGB", SIZE, BLUE)
    image.paste(RED, (0, 0, SIZE[0] // 2, SIZE[1] // 2))
    saved(tmp_path / f"a.{ending}", image, exif=exif(orientation), quality=95)
    (frame,) = open_source(tmp_path / f"a.{ending}").frames(Sampling())
    width, height = frame.image.size
    assert (width, height) == (SIZE if orientation in (1, 3) else SIZE[::-1])
    right, low = CORNERS[orientation]
    shown = np.asarray(frame.image)[height // 4 + low * height // 2, width // 4 + right * width // 2]
    assert np.abs(shown.astype(int) - RED).max() < 12
    assert frame.name == "a"


def test_every_picture_of_a_folder_is_read_or_named(tmp_path, caplog):
    folder(tmp_path, "IMG_0001.HEIC", "IMG_0002.JPG", "IMG_0003.heif", "IMG_0004.avif")
    for name in ("IMG_0005.DNG", "IMG_0006.jxl", "IMG_0007.CR3", "clip.MOV", "a.gif", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    clip = load_clip(tmp_path, size=28)
    assert clip.frame_names == [f"IMG_000{number}" for number in (1, 2, 3, 4)]
    (said,) = caplog.messages
    assert "left out, as .cr3, .dng, .gif, .jxl, .mov is not read as a frame: " in said
    assert "a.gif, clip.MOV, IMG_0005.DNG, IMG_0006.jxl, IMG_0007.CR3" in said


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (("frame-0.color.png", "frame-0.depth.png", "frame-1.color.png", "frame-1.depth.png"), "frame-*.color.png"),
        (("0001.jpg", "0001.png", "0002.jpg", "0002.png"), "*.jpg"),
        (("IMG_1.HEIC", "IMG_1.JPG"), "*.HEIC"),
        (("_Color_1.png", "_Depth_1.png", "_Color_2.png", "_Depth_2.png"), "_Color_*.png"),
        (("rgb_00.png", "mask_00.png", "rgb_01.png", "mask_01.png"), "rgb_*.png"),
        (("frame_0.png", "dynamic_mask_0.png", "enlarged_dynamic_mask_0.png", "frame_1.png"), "frame_*.png"),
        (("00000.png", "00000_normal.png", "00001.png", "00001_normal.png"), None),
        (("a/1.png", "a/1_disp.png", "a/2.png"), "a/1.png"),
    ],
)
@pytest.mark.parametrize("asked", ["", "*"])
def test_depth_maps_and_masks_beside_frames(tmp_path, names, pattern, asked):
    place = folder(tmp_path, *names) / names[0].rpartition("/")[0]
    with pytest.raises(ClipError) as error:
        open_source(str(place / asked))
    if pattern is None:
        assert "put the frames into a folder of their own" in str(error.value)
    elif "*" in pattern:
        assert f"give the pattern '{tmp_path / pattern}'" in str(error.value)
        frames = open_source(str(tmp_path / pattern)).frames(Sampling())
        assert not {frame.name for frame in frames} & {name for name in names if "mask" in name or "epth" in name}


def test_pictures_of_one_kind_are_a_clip(tmp_path, caplog):
    depth = folder(tmp_path / "depth", *(f"depth_{number}.png" for number in range(3)))
    folder(tmp_path / "views", *(f"cam{camera}/0001.png" for camera in range(3)))
    assert len(load_clip(depth, size=28)) == 3
    assert len(load_clip(f"{tmp_path}/views/*/*.png", size=28)) == 3
    assert not caplog.messages


@pytest.mark.parametrize(
    ("frames", "odd"),
    [(2, "cover.jpg"), (5, "preview.webp"), (5, "Screenshot 2024-01-01.png"), (5, "frame_0001 copy.png")],
)
def test_a_picture_named_unlike_the_others(tmp_path, caplog, frames, odd):
    folder(tmp_path, *(f"frame_{number:04d}.png" for number in range(frames)), odd)
    assert len(load_clip(tmp_path, size=28)) == frames + 1
    (said,) = caplog.messages
    assert f"named unlike the others: {odd}" in said
    assert f"give the pattern '{tmp_path}/frame_" in said or "folder of their own" in said


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.heic", "a.mp4", "a.webp"])
def test_an_empty_file(tmp_path, name):
    (tmp_path / name).touch()
    with pytest.raises(ClipError, match=r"is empty \(0 bytes\)"):
        load_clip(tmp_path / name)


@pytest.mark.parametrize("name", ["take[1]", "a*b", "what?", "[x]/[y]"])
def test_the_name_of_a_folder_is_no_pattern(tmp_path, name, monkeypatch):
    folder(tmp_path / name, "1.png", "2.png", "3.jpg")
    for pattern in (str(tmp_path / name / "*.png"), f"{tmp_path / name}/**/*.png"):
        assert len(list(open_source(pattern).frames(Sampling()))) == 2
    monkeypatch.chdir(tmp_path)
    assert len(list(open_source(f"{name}/[12].png").frames(Sampling()))) == 2


@pytest.mark.parametrize(("most", "is_said"), [(1023, True), (4095, True), (65535, False), (20000, False), (0, False)])
@pytest.mark.parametrize("shape", [(32, 64), (32, 64, 3)])
def test_sixteen_bits_that_hold_fewer(tmp_path, caplog, most, is_said, shape):
    for number in range(3):
        values = np.linspace(0, most, np.prod(shape)).reshape(shape).astype(np.uint16)
        write(tmp_path / f"{number}.png", png(values))
    load_clip(tmp_path, size=28)
    assert len(caplog.messages) == is_said  # once for all frames
    assert not is_said or "16 bits a value and uses at most 12" in caplog.messages[0]


@pytest.mark.parametrize(
    ("folder", "low", "high", "is_depth"),
    [
        ("frames", 700, 6000, True),  # millimetres
        ("frames", 60000, 65535, True),
        ("depth", 0, 65535, True),
        ("left", 0, 40000, False),  # a grey film
    ],
)
def test_depth_maps_are_no_film(tmp_path, folder, low, high, is_depth):
    for number in range(3):
        values = np.linspace(low, high, 32 * 64).reshape(32, 64).astype(np.uint16)
        values[number, :9] = 0  # unknown
        write(tmp_path / folder / f"{number}.png", png(values))
    paths = [tmp_path / folder / f"{number}.png" for number in range(3)]
    for source in (tmp_path / folder, tmp_path / folder / "*.png", paths):
        if is_depth:
            with pytest.raises(ClipError, match=r"single-channel pictures, likely depth maps \(0.png\); give"):
                open_source(source)
        else:
            assert open_source(source).total(Sampling()) == 3
    assert open_source(paths[0]).total(Sampling()) == 1  # named on purpose


@pytest.mark.parametrize("name", ["a.webp", "a.png", "a.avif", "hidden.png"])
def test_animations_have_frames_and_times(tmp_path, name):
    colours, times = [(40 * index, 60, 200) for index in range(5)], [100, 40, 300, 20, 100]
    pictures = [Image.new("RGB", SIZE, colour) for colour in colours]
    options: dict[str, Any] = {"lossless": True} if name == "a.webp" else {"quality": 95} if name == "a.avif" else {}
    first = pictures[0]
    if name == "hidden.png":  # a picture for programs that show no animations
        first, options = Image.new("RGB", SIZE, "white"), {"default_image": True}
    rest = pictures if first is not pictures[0] else pictures[1:]
    first.save(tmp_path / name, save_all=True, append_images=rest, duration=times, **options)
    source = open_source(tmp_path / name)
    frames = list(source.frames(Sampling()))
    assert [frame.name for frame in frames] == [f"{index:06d}" for index in range(5)]
    np.testing.assert_allclose([frame.time or 0 for frame in frames], [0, 0.1, 0.14, 0.44, 0.46])
    for frame, colour in zip(frames, colours, strict=True):
        assert np.abs(np.asarray(frame.image).astype(int) - colour).max() <= 4
    assert [int(frame.name) for frame in source.frames(Sampling(fps=5))] == [0, 3]
    assert source.total(Sampling(start=1, stride=2)) == 2
    clip = load_clip(tmp_path / name, size=28)
    assert clip.timestamps is not None
    assert clip.source.name == name.partition(".")[0]


def test_an_animation_that_breaks_off(tmp_path):
    noise = [Image.fromarray(np.random.default_rng(i).integers(0, 256, (32, 64, 3), np.uint8)) for i in range(6)]
    path = tmp_path / "a.png"
    noise[0].save(path, save_all=True, append_images=noise[1:], duration=50)
    path.write_bytes(path.read_bytes()[:20000])
    assert isinstance(open_source(path), Animation)
    with pytest.raises(ClipError, match=r"a.png breaks off at frame [1-5]"):
        list(open_source(path).frames(Sampling()))


@pytest.mark.parametrize("name", ["a.tif", "a.heic"])
def test_other_files_of_several_pictures(tmp_path, caplog, name):
    image = Image.new("RGB", SIZE, RED)
    saved(tmp_path / name, image, image, image)
    with caplog.at_level(logging.WARNING):
        assert len(load_clip(tmp_path / name, size=28)) == 1
    assert "holds 3 pictures; the first is read" in caplog.messages[0]


def test_panoramas_are_warned_of_once(tmp_path, caplog):
    xmp = b'<rdf:Description xmlns:GPano="x" GPano:ProjectionType="equirectangular"/>'
    for number in range(2):
        Image.new("RGB", (112, 56)).save(tmp_path / f"{number}.jpg", xmp=xmp)
    load_clip(tmp_path, size=28)
    (said,) = caplog.messages
    assert "0.jpg is a panorama of 360 degrees (equirectangular)" in said
