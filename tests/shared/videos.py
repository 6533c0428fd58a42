"""Videos for tests: small pictures that tell their number, at any times."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

WIDTH, HEIGHT = 64, 48


def picture(index: int) -> np.ndarray:
    """Return a red left half, a blue upper half over it, and the index as green."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, : WIDTH // 2, 0] = 200
    pixels[: HEIGHT // 2, :, 2] = 200
    pixels[..., 1] = 10 * index
    return pixels


def encode(path: Path, pictures: Iterable[np.ndarray], codec="mpeg4", pixels="yuv420p", *, bits=0, **options) -> Path:
    """Write pictures [H, W, 3 or 4] by a codec, 25 a second; `bits` a second, and options of the codec."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=25, options=options)
        first, *others = pictures
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt, stream.bit_rate = pixels, bits
        for number, values in enumerate((first, *others)):
            frame = av.VideoFrame.from_ndarray(values, format="rgb24" if values.shape[2] == 3 else "rgba")
            frame = frame.reformat(format=pixels)
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_video(path: Path, times: Iterable[int], size: tuple[int, int] = (WIDTH, HEIGHT), **options: str) -> Path:
    """Write one picture per time in milliseconds."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height = size
        stream.pix_fmt, stream.bit_rate = "yuv420p", 2_000_000
        stream.codec_context.time_base = Fraction(1, 1000)
        for index, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(picture(index), format="rgb24").reformat(*size)
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
