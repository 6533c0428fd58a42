"""Image files of every kind and frames in memory as RGB of 8 bits, and what cannot be read."""

import numpy as np
import pytest
from PIL import Image

from tests.shared.dataset_files import png, write
from vggtjax.clips.media.arrays import ArrayFrames, eight_bit
from vggtjax.clips.media.images import read_image
from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import ClipError

RAMP = np.array([[0, 128, 129, 33023, 65535]], np.uint16)
RAMP_8 = [0, 0, 1, 128, 255]


def pixels(path):
    image = read_image(path)
    assert image.mode == "RGB"
    return np.asarray(image)


def save(path, image, **options):
    image.save(path, **options)
    return path


@pytest.mark.parametrize("name", ["grey.png", "grey.tif"])
def test_sixteen_bit_grey_is_scaled_not_clipped(tmp_path, name):
    image = pixels(save(tmp_path / name, Image.fromarray(RAMP)))
    np.testing.assert_array_equal(image, np.repeat(np.array([RAMP_8])[..., None], 3, 2))


def test_sixteen_bit_colour_is_scaled_not_clipped(tmp_path):
    path = write(tmp_path / "colour.png", png(np.array([[[0, 32896, 65535], [65535, 0, 257]]], np.uint16)))
    np.testing.assert_array_equal(pixels(path), [[[0, 128, 255], [255, 0, 1]]])


def test_floating_point_and_more_than_sixteen_bits(tmp_path):
    deep = save(tmp_path / "deep.tif", Image.fromarray(np.array([[70000, 0]], np.int32)))
    with pytest.raises(ClipError, match=r"frame deep.tif has values from 0 to 70000; expected 16 bits"):
        read_image(deep)
    signed = Image.fromarray(RAMP.astype(np.int32))
    np.testing.assert_array_equal(pixels(save(tmp_path / "signed.tif", signed))[0, :, 0], RAMP_8)
    image = pixels(save(tmp_path / "float.tif", Image.fromarray(np.array([[0, 0.5, 1]], np.float32))))
    np.testing.assert_array_equal(image[..., 0], [[0, 128, 255]])
    path = save(tmp_path / "nan.tif", Image.fromarray(np.array([[np.nan, 0.5]], np.float32)))
    with pytest.raises(ClipError, match=r"frame nan.tif has values that are not finite"):
        read_image(path)


def test_transparency_is_composited_over_white(tmp_path):
    clear, half = (10, 20, 30, 0), (0, 100, 200, 128)
    image = Image.new("RGBA", (2, 1), clear)
    image.putpixel((1, 0), half)
    expected = [[[255, 255, 255], [127, 177, 227]]]
    np.testing.assert_array_equal(pixels(save(tmp_path / "rgba.png", image)), expected)

    grey = Image.new("LA", (2, 1), (10, 0))
    grey.putpixel((1, 0), (100, 255))
    np.testing.assert_array_equal(pixels(save(tmp_path / "la.png", grey))[0, :, 0], [255, 100])


def test_palettes_one_bit_and_cmyk(tmp_path):
    palette = Image.new("P", (3, 1))
    palette.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    palette.putdata([0, 1, 2])
    colours = [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    np.testing.assert_array_equal(pixels(save(tmp_path / "p.png", palette))[0], colours)
    colours[0] = [255, 255, 255]
    np.testing.assert_array_equal(pixels(save(tmp_path / "clear.png", palette, transparency=0))[0], colours)
    bits = Image.new("1", (2, 1))
    bits.putpixel((1, 0), 1)
    np.testing.assert_array_equal(pixels(save(tmp_path / "bits.png", bits))[0, :, 0], [0, 255])
    ink = Image.new("CMYK", (8, 8), (0, 255, 255, 0))
    assert np.abs(pixels(save(tmp_path / "ink.jpg", ink, quality=100)).astype(int) - (255, 0, 0)).max() < 8


def test_exif_orientation(tmp_path):
    image = Image.new("RGB", (4, 2), "black")
    image.putpixel((0, 0), (255, 255, 255))
    exif = Image.Exif()
    exif[0x0112] = 6  # shown turned by 90 degrees clockwise: the upper left corner goes to the upper right
    turned = pixels(save(tmp_path / "a.png", image, exif=exif))
    assert turned.shape == (4, 2, 3)
    assert turned[0, 1].tolist() == [255, 255, 255]
    assert turned.sum() == 3 * 255


@pytest.mark.parametrize(("ending", "kept"), [("png", 0.6), ("jpg", 0.6), ("tif", 0.6), ("webp", 0.6), ("png", 0)])
def test_truncated_files(tmp_path, ending, kept):
    noise = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    path = save(tmp_path / f"cut.{ending}", Image.fromarray(noise))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(ClipError, match=f"cut.{ending}"):
        read_image(path)


def test_files_that_are_no_images(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(ClipError, match="does not exist"):
        read_image(path)
    path.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n")  # a program for another interpreter
    with pytest.raises(ClipError, match="not an image of a known format; expected one of PNG, JPEG"):
        read_image(path)
    with pytest.raises(ClipError, match=r"cannot read image .*directory"):
        read_image(tmp_path)


def test_an_absurdly_large_image(tmp_path, monkeypatch):
    path = save(tmp_path / "cut.png", Image.new("1", (4000, 3000)))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ClipError, match=r"bytes and says it has 4000 x 3000 pixels; get it whole"):
        read_image(path)
    path = save(tmp_path / "bomb.png", Image.new("1", (400, 400)))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 400 * 400 // 3)
    with pytest.raises(ClipError, match=r"cannot read image .*bomb.png.*exceeds limit"):
        read_image(path)


def test_depths():
    values = np.array([0, 128, 129, 385, 386, 65406, 65407, 65535], np.uint16)
    np.testing.assert_array_equal(eight_bit(values, "a"), [0, 0, 1, 1, 2, 254, 255, 255])
    np.testing.assert_array_equal(eight_bit(np.array([256, 65535], ">u2"), "a"), [1, 255])
    np.testing.assert_array_equal(eight_bit(np.array([0, 0.5, 1]), "a"), [0, 128, 255])
    values = np.arange(256, dtype=np.uint8)
    for dtype in (np.float16, np.float32):  # 8 bits survive
        np.testing.assert_array_equal(eight_bit((values / 255).astype(dtype), "a"), values)


BLACK = np.zeros((4, 5, 3), np.uint8)


def test_what_is_no_frame():
    for arrays, message in (
        (np.full((1, 2, 2, 3), np.nan), "frame 000000 has values that are not finite"),
        (np.full((1, 2, 2, 3), 1.5), r"has values from 1.5 to 1.5; expected floating point in \[0, 1\]"),
        (np.ones((1, 2, 2, 3), int), "frame 000000 has values of type int64"),
        (BLACK, r"the array has shape \(4, 5, 3\); expected frames \[S, H, W, 3\]"),
        ([BLACK, BLACK[..., 0]], r"frame 000001 has shape \(4, 5\)"),
    ):
        with pytest.raises(ClipError, match=message):
            list(ArrayFrames.from_arrays(arrays).frames(Sampling()))


def test_colours_first_and_batches_are_named_with_the_remedy():
    with pytest.raises(ClipError, match=r"colours first; .*: array\.transpose\(0, 2, 3, 1\), or tensor\.permute"):
        ArrayFrames.from_arrays(np.zeros((4, 3, 28, 42), np.float32))
    with pytest.raises(ClipError, match=r"shape \(1, 4, 28, 42, 3\); give the clips of a batch one by one"):
        ArrayFrames.from_arrays(np.zeros((1, 4, 28, 42, 3), np.float32))


def test_frames_are_named_by_their_index_in_the_source():
    arrays = (np.arange(5, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 3, 3), np.uint8))[:, :, ::-1]
    source = ArrayFrames.from_arrays(arrays)
    sampling = Sampling(start=1, stride=2)
    frames = list(source.frames(sampling))
    assert source.total(sampling) == 2
    assert [frame.name for frame in frames] == ["000001", "000003"]
    assert [np.asarray(frame.image)[0, 0, 0] for frame in frames] == [1, 3]
    assert all(frame.time is None and frame.image.mode == "RGB" and frame.image.size == (3, 2) for frame in frames)


def test_bytes_in_16_bits_are_refused_and_dark_frames_of_16_bits_are_not():
    values = np.arange(4 * 5 * 6 * 3).reshape(4, 5, 6, 3) % 256
    for arrays in (values.astype(np.uint16), list(values.astype(">u2"))):
        with pytest.raises(ClipError, match=r"uint16 and have no value above 255, .*; give array\.astype\(np\.uint8\)"):
            ArrayFrames.from_arrays(arrays)
    values[3, 0, 0, 0] = 256
    assert len(ArrayFrames.from_arrays(values.astype(np.uint16)).arrays) == 4
