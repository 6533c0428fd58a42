"""Interlaced videos: both fields of a frame are of different times, which shows as combs where something moves."""

from fractions import Fraction
from typing import Any

import av
import av.filter
import numpy as np
import pytest
from av.codec.context import Flags

from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.media.video import VideoFile

WIDTH, HEIGHT, COUNT = 96, 64, 6


def field(time, left=0):
    """A white block on grey that moves 8 pixels a field."""
    pixels = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    pixels[16:48, left + 8 * time : left + 8 * time + 16] = 220
    return pixels


def write(path, codec, pixel, first_field):
    """Write frames of two fields each; `first_field` is 0 for the upper one."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixel
        coder = stream.codec_context
        coder.bit_rate, coder.colorspace, coder.color_primaries, coder.color_trc = 4_000_000, 1, 1, 1
        coder.flags |= int(Flags.interlaced_dct) | int(Flags.interlaced_me)
        for index in range(COUNT):
            pixels = field(2 * index % 10)
            pixels[1 - first_field :: 2] = field(2 * index % 10 + 1)[1 - first_field :: 2]
            whole = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame = whole.reformat(format="yuv444p", dst_colorspace=1)  # chroma of lines of other times is not mixed
            if pixel != "yuv444p":
                frame = frame.reformat(format=pixel, dst_colorspace=1)
            frame = marked(frame, ("tff", "bff")[first_field])
            frame.pts, frame.time_base = index, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def marked(frame, order):
    """Return a frame that says which of its fields is the first."""
    graph = av.filter.Graph()
    source = graph.add_buffer(width=WIDTH, height=HEIGHT, format=frame.format, time_base=Fraction(1, 25))
    graph.link_nodes(source, graph.add("setfield", order), graph.add("buffersink")).configure()
    graph.vpush(frame)
    return graph.vpull()


def combs(pixels):
    """How much rows differ from both of their neighbours: large only where fields of two times alternate."""
    rows = pixels.astype(int).mean(axis=-1)
    return np.abs(2 * rows[1:-1] - rows[:-2] - rows[2:])[20:40].max()


CASES = [
    ("ts", "libx264", "yuv420p", 0),
    ("mp4", "libx264", "yuv420p", 1),
    ("mkv", "libx264", "yuv422p10le", 0),
    ("mpg", "mpeg2video", "yuv420p", 0),
    ("mov", "prores_ks", "yuv422p10le", 0),
]


@pytest.mark.parametrize(("ending", "codec", "pixel", "first_field"), CASES)
def test_interlaced_videos_lose_their_combs(tmp_path, caplog, ending, codec, pixel, first_field):
    path = write(tmp_path / f"a.{ending}", codec, pixel, first_field)
    frames = list(VideoFile(path).frames(Sampling()))
    assert [frame.name for frame in frames] == [f"{index:06d}" for index in range(COUNT)]
    np.testing.assert_allclose([frame.time or 0 for frame in frames], np.arange(COUNT) / 25, atol=1e-3)
    for index, frame in enumerate(frames):
        pixels = np.asarray(frame.image)
        assert combs(pixels) < 60
        assert np.abs(pixels[20:44, 8 * (2 * index % 10) + 2 : 8 * (2 * index % 10) + 6].astype(int) - 220).max() < 30
    assert caplog.messages == [f"{path} is interlaced; its frames are deinterlaced, one for each pair of fields"]
