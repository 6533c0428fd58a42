"""Colours of videos: HDR and wide gamuts as sRGB, and videos that do not say what their numbers mean."""

from fractions import Fraction
from typing import Any

import av
import numpy as np
import pillow_heif
import pytest
from av.video.frame import VideoFrame

from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.media.video import VideoFile

PATCHES = [(200, 40, 40), (40, 180, 40), (40, 40, 200), (128, 128, 128), (230, 200, 170), (16, 16, 16)]
HLG, PQ, SRGB, BT709 = 18, 16, 13, 1
PRIMARIES_BT2020, PRIMARIES_P3 = 9, 12
LUMINANCE = {9: (0.2627, 0.6780, 0.0593), 1: (0.2126, 0.7152, 0.0722), 5: (0.299, 0.587, 0.114)}
# From linear BT.709 (ITU-R BT.2087; P3 from its chromaticities).
FROM_BT709 = {
    1: np.eye(3),
    9: np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]),
    12: np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]]),
}


def chart(size=64):
    """Return patches over a gradient of grey, sRGB [size, 96, 3]."""
    pixels = np.zeros((size, 96, 3), np.uint8)
    for number, colour in enumerate(PATCHES):
        pixels[: size // 2, 16 * number : 16 * (number + 1)] = colour
    pixels[size // 2 :] = np.linspace(0, 255, 96).round()[:, None]
    return pixels


def coded(srgb, transfer, primaries):
    """Return sRGB in another transfer and other primaries, in [0, 1]; white is 203 nits, as in BT.2408."""
    values = srgb / 255.0
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    light = light @ FROM_BT709[primaries].T
    if transfer == SRGB:
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    if transfer == PQ:
        power = (light * 203 / 10000) ** (2610 / 16384)
        return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    display = light * 203 / 1000
    luminance = np.maximum(display @ LUMINANCE[9 if primaries == 9 else 1], 1e-9)[..., None]
    scene = display * luminance ** ((1 - 1.2) / 1.2)
    a, b, c = 0.17883277, 1 - 4 * 0.17883277, 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


def planes(rgb, matrix, bits):
    """Return limited-range YCbCr of values in [0, 1], 4:4:4, as whole numbers of `bits`."""
    kr, kg, kb = LUMINANCE[matrix]
    y = rgb @ (kr, kg, kb)
    cb, cr = (rgb[..., 2] - y) / (2 - 2 * kb), (rgb[..., 0] - y) / (2 - 2 * kr)
    scaled = [16 + 219 * y, 128 + 224 * cb, 128 + 224 * cr]
    return [np.rint(plane * 2 ** (bits - 8)).astype(np.uint16) for plane in scaled]


def write(path, rgb, matrix, codec="libx264", pixel="yuv444p10le", tags=(None, None, None), **options):
    """Write frames of values in [0, 1] by a codec; `tags` are the matrix, transfer and primaries that the file says."""
    bits = 10 if "p10" in pixel else 8
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=10, options=options)
        stream.height, stream.width = rgb.shape[:2]
        stream.pix_fmt, stream.codec_context.time_base = pixel, Fraction(1, 10)
        stream.codec_context.color_range = 1
        for name, tag in zip(("colorspace", "color_trc", "color_primaries"), tags, strict=True):
            if tag is not None:
                setattr(stream.codec_context, name, tag)
        y, cb, cr = planes(rgb, matrix, bits)
        if "420" in pixel:
            cb, cr = (plane.reshape(len(y) // 2, 2, -1, 2).mean(axis=(1, 3)).round() for plane in (cb, cr))
        frame = VideoFrame(rgb.shape[1], rgb.shape[0], pixel)
        for plane, values in zip(frame.planes, (y, cb, cr), strict=True):
            values = values.astype(np.uint16 if bits > 8 else np.uint8)
            row = np.zeros((plane.height, plane.line_size // values.itemsize), values.dtype)
            row[:, : plane.width] = values
            plane.update(row.tobytes())
        for index in range(2):
            frame.pts, frame.time_base = index, Fraction(1, 10)
            for name, tag in zip(("colorspace", "color_trc", "color_primaries"), tags, strict=True):
                if tag is not None:
                    setattr(frame, name, tag)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def first(path):
    return np.asarray(next(VideoFile(path).frames(Sampling())).image).astype(int)


@pytest.mark.parametrize(
    ("transfer", "primaries", "ending", "codec", "pixel"),
    [
        (HLG, PRIMARIES_BT2020, "mov", "libx265", "yuv420p10le"),  # iPhone
        (HLG, PRIMARIES_BT2020, "mp4", "libx264", "yuv444p10le"),
        (HLG, PRIMARIES_BT2020, "mkv", "ffv1", "yuv420p10le"),  # only the container says it
        (PQ, PRIMARIES_BT2020, "mp4", "libx265", "yuv420p10le"),  # HDR10
        (PQ, PRIMARIES_BT2020, "webm", "libsvtav1", "yuv420p10le"),
        (PQ, PRIMARIES_P3, "mkv", "libx264", "yuv444p10le"),
        (HLG, BT709, "mkv", "libx264", "yuv444p10le"),
        (SRGB, PRIMARIES_BT2020, "mp4", "libx264", "yuv444p10le"),  # wide, but not HDR
        (SRGB, PRIMARIES_P3, "mov", "libx264", "yuv444p10le"),
    ],
)
def test_colours_come_out_as_srgb(tmp_path, caplog, transfer, primaries, ending, codec, pixel):
    quality = {
        "libx264": {"crf": "0"},
        "libx265": {"x265-params": "lossless=1:log-level=0:bframes=0"},  # with B frames, two frames have random dts
        "libsvtav1": {"crf": "5"},
    }
    path, matrix, sdr = tmp_path / f"a.{ending}", 9 if primaries == 9 else 1, chart()
    tags, options = (matrix, transfer, primaries), quality.get(codec, {})
    write(path, coded(sdr, transfer, primaries), matrix, codec, pixel, tags, **options)
    difference = np.abs(first(path) - sdr)
    inner = np.concatenate([difference[4:28, 16 * n + 4 : 16 * n + 12] for n in range(6)])  # chroma bleeds
    assert inner.max() <= 4
    assert difference[36:].max() <= 8
    (said,) = caplog.messages
    assert {HLG: "HDR (HLG)", PQ: "HDR (PQ)", SRGB: "wide gamut"}[transfer] in said


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_highlights_roll_off(tmp_path, transfer):
    light = np.geomspace(0.5, 4.9, 96)  # of white
    steps = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    sdr = np.repeat((255 * steps)[None, :, None], 3, axis=2).repeat(64, axis=0)
    path = write(tmp_path / "a.mkv", coded(sdr, transfer, 9), 9, "ffv1", tags=(9, transfer, 9))
    shown = first(path)[32]
    np.testing.assert_array_equal(shown, shown[:, :1].repeat(3, axis=1))  # grey stays grey
    assert (np.diff(shown[:, 0]) >= 0).all()
    assert shown[light < 1, 0].max() <= 251 < shown[-1, 0] <= 255


@pytest.mark.parametrize(
    ("size", "tag", "expected"),
    [
        ((480, 640), None, 5),
        ((576, 720), None, 5),
        ((720, 96), None, 1),
        ((720, 1280), None, 1),
        ((544, 1280), None, 1),  # a wide film
        ((1080, 96), None, 1),
        ((720, 96), 5, 5),  # what a file says counts
        ((480, 96), 1, 1),
    ],
)
def test_videos_without_colour_tags(tmp_path, caplog, size, tag, expected):
    green = np.broadcast_to(np.array([40, 180, 40]) / 255, (*size, 3))
    options = {"crf": "5", "preset": "ultrafast"}
    path = write(tmp_path / "a.mp4", green, expected, "libx264", "yuv420p", (tag, None, None), **options)
    assert np.abs(first(path)[8:-8, 8:-8] - (40, 180, 40)).max() <= 4
    assert not caplog.messages


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_photos_in_hdr(tmp_path, caplog, transfer):
    sdr = chart()
    codes = np.rint(coded(sdr, transfer, 9) * 65535).astype("<u2")
    tags = {"color_primaries": 9, "transfer_characteristics": transfer, "matrix_coefficients": 9, "full_range_flag": 1}
    picture = pillow_heif.from_bytes("RGB;16", codes.shape[1::-1], codes.tobytes())
    picture.save(tmp_path / "a.hif", quality=-1, chroma=444, **tags)
    (frame,) = ImageFiles((tmp_path / "a.hif",)).frames(Sampling())
    difference = np.abs(np.asarray(frame.image).astype(int) - sdr)
    assert max(difference[4:28, 16 * number + 4 : 16 * number + 12].max() for number in range(6)) <= 8
    assert f"HDR ({'HLG' if transfer == HLG else 'PQ'})" in caplog.messages[0]
