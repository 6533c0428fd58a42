"""Rows of pictures, videos and masks."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from tests.fuzz import samples
from tests.fuzz.cases import Reader
from tests.fuzz.samples import clip
from vggtjax.clips.images import read_image
from vggtjax.clips.masks import load_masks
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import open_source

_CODECS = {  # container -> codec; gif and mxf hold no other
    **dict.fromkeys((".mp4", ".mov", ".mkv", ".avi", ".ts", ".m4v", ".3gp"), "mpeg4"),
    **{
        ".webm": "libvpx",
        ".mpg": "mpeg1video",
        ".wmv": "wmv2",
        ".flv": "flv",
        ".ogv": "libvpx",
        ".mxf": "mpeg2video",
    },
    ".gif": "gif",
}


def read_frames(path: Path) -> None:
    for _ in open_source(path).frames(Sampling(max_frames=5)):
        pass


def _pictures(folder: Path) -> Path:
    for number in range(3):
        Image.fromarray(samples.pixels(number)).save(folder / f"{number}.{('png', 'jpg', 'webp')[number]}")
    return folder


_PICTURES = {  # suffix -> slack: the last ones can hold 16 million pixels in a few hundred bytes
    **dict.fromkeys((".png", ".jpg", ".bmp", ".ppm", ".tga"), 48 * 2**20),
    **dict.fromkeys((".tif", ".webp", ".jp2", ".avif"), 2**28),
}

_VIDEO = 384 * 2**20  # slack: a damaged packet may say 8 million pixels, of which a decoder holds several frames

ROWS = (
    *(
        Reader(f"picture {suffix}", samples.picture_file(f"picture{suffix}"), read_image, slack)
        for suffix, slack in _PICTURES.items()
    ),
    *(
        Reader(f"video {suffix}", samples.video_file(suffix, codec), read_frames, _VIDEO)
        for suffix, codec in _CODECS.items()
    ),
    Reader("folder of pictures", samples.made(lambda folder: (folder.mkdir(), _pictures(folder))), read_frames),
    Reader("masks", samples.masks, lambda path: load_masks(path, clip())),
)
