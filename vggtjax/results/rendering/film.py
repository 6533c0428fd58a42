"""Film files: .mp4 by PyAV, .gif and .webp by Pillow."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vggtjax.errors import InputError, OutputError
from vggtjax.storage.writing import writing

Frames = Iterator[UInt8[np.ndarray, "H W 3"]]
_QUALITY = "20"  # constant rate factor of H.264: hardly any loss
_WEBP_QUALITY = 75
_BT709 = 1  # matrix, primaries and transfer of an .mp4, for players and for us
_PALETTE_FRAMES = 12  # of a .gif, whose colours make its one palette


def check_film(path: str | Path, fps: float) -> None:
    """Raise InputError for a file whose name does not end with .mp4, .gif or .webp, a folder, or fps out of range."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise InputError(f"{path} has no known ending of a film; expected one of {', '.join(_WRITERS)}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected the name of a film")
    most = 50 if suffix == ".gif" else 120
    if not 0 < fps <= most:
        raise InputError(f"fps is {fps!r}; expected a number above 0, at most {most} for {suffix}")


def write_film(path: str | Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], fps: float) -> None:
    """Write frames of one size as a film, which appears under its name when it is whole.

    An .mp4 (H.264, yuv420p) has even sides: an odd last row or column is left out. A .gif has one palette for all
    frames, holds them in memory meanwhile, and rounds the time of a frame to 1/100 s; .gif and .webp repeat for ever.

    Args:
        path: ends with .mp4, .gif or .webp.
        frames: at least one, of at least 2 x 2 pixels for an .mp4; taken one at a time.
        fps: frames per second, above 0, at most 120, for a .gif at most 50.

    Raises:
        InputError: another ending, no frame, frames of several sizes, or fps out of range.
        OutputError: the file cannot be written, or PyAV has no encoder for an .mp4.
    """
    path = Path(path)
    check_film(path, fps)
    checked = _alike(iter(frames))
    first = next(checked, None)
    if first is None:
        raise InputError("a film needs at least one frame")
    with writing(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, chain([first], checked), fps)


def mp4_codec() -> str | None:
    """Return the name of PyAV's encoder for an .mp4, None without one."""
    import av

    return next((name for name in ("libx264", "mpeg4") if name in av.codecs_available), None)


def _alike(frames: Frames) -> Frames:
    shape = None
    for frame in frames:
        shape = frame.shape if shape is None else shape
        if frame.shape != shape or frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise InputError(f"a frame of the film is {frame.dtype} {frame.shape}; expected uint8 (height, width, 3), "
                             f"all of one size (the first is {shape})")  # fmt: skip
        yield frame


def _write_mp4(path: Path, frames: Frames, fps: float) -> None:
    import av
    from av.video.reformatter import VideoReformatter

    reformatter = VideoReformatter()  # keeps its tables from frame to frame
    codec = mp4_codec()
    if codec is None:
        raise OutputError("this PyAV has no encoder for an .mp4; write a .gif or a .webp")
    options = {"crf": _QUALITY, "preset": "medium"} if codec == "libx264" else {"qscale": "3"}
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream: Any = None
        for frame in frames:
            height, width = (side // 2 * 2 for side in frame.shape[:2])
            if stream is None:
                if not height or not width:
                    raise InputError(f"a frame of {frame.shape[1]} x {frame.shape[0]} pixels is too small for an .mp4")
                stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1000), options=options)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                coder = stream.codec_context
                coder.colorspace = coder.color_primaries = coder.color_trc = _BT709
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame[:height, :width]), format="rgb24")
            container.mux(stream.encode(reformatter.reformat(picture, format="yuv420p", dst_colorspace=_BT709)))
        container.mux(stream.encode())


def _write_gif(path: Path, frames: Frames, fps: float) -> None:
    pictures = [Image.fromarray(frame) for frame in frames]
    shown = np.linspace(0, len(pictures) - 1, min(len(pictures), _PALETTE_FRAMES)).round().astype(int)
    together = np.concatenate([np.asarray(pictures[number]) for number in shown])
    palette = Image.fromarray(together).quantize(255, Image.Quantize.MEDIANCUT)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, format="GIF", save_all=True, append_images=others, duration=_times(len(pictures), fps), loop=0)


def _times(count: int, fps: float) -> list[int]:
    """Return the milliseconds of every frame of a .gif, in hundredths of a second: early and late by turns."""
    ends = [10 * round(100 * number / fps) for number in range(count + 1)]
    return [end - start for start, end in pairwise(ends)]


def _write_webp(path: Path, frames: Frames, fps: float) -> None:
    pictures = (Image.fromarray(frame) for frame in frames)
    time = math.ceil(1000 / fps)
    next(pictures).save(
        path, format="WEBP", save_all=True, append_images=pictures, duration=time, loop=0, quality=_WEBP_QUALITY
    )


_WRITERS: dict[str, Callable[[Path, Frames, float], None]] = {
    ".mp4": _write_mp4,
    ".gif": _write_gif,
    ".webp": _write_webp,
}
