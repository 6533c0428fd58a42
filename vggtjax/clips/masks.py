"""Masks that a user brings, as the clip's frames see them. Does not import jax."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool

from vggtjax.clips.clip import Clip
from vggtjax.clips.images import ImageFiles, read_image
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError

_WHITE = 127  # above it, a pixel moves


def load_masks(folder: str | Path, clip: Clip) -> Bool[np.ndarray, "S H W"]:
    """Load pictures that are bright where something moves, and bring them to the clip's frames.

    Crop, scale and padding are those of the frames: every pixel takes the value at the place in the source that its
    centre shows, and padding is static.

    Args:
        folder: a picture per frame. Names decide which is whose, where every frame's is there (`frame_3.png` for
            `frame_3.jpg`); else there must be as many as frames, in the same order.
        clip: what `load_clip` returned.

    Raises:
        ClipError: a folder without pictures, pictures that cannot be told to frames, or of another shape than theirs.
    """
    source = open_source(str(folder))
    if not isinstance(source, ImageFiles):
        raise ClipError(f"{folder} is no folder of pictures; masks need one picture per frame")
    by_name = {path.stem: path for path in source.paths}
    paths = [by_name.get(name) for name in clip.frame_names]
    if None in paths:
        missing = clip.frame_names[paths.index(None)]
        if len(source.paths) != len(clip):
            raise ClipError(
                f"{folder} has {len(source.paths)} pictures for {len(clip)} frames, and none is named {missing}; "
                "expected a picture for every frame, named like it or in the same order"
            )
        paths = list(source.paths)
    return np.stack([_mask(path, clip, frame) for frame, path in enumerate(paths) if path is not None])


def _mask(path: Path, clip: Clip, frame: int) -> Bool[np.ndarray, "H W"]:
    picture = np.asarray(read_image(path)).max(axis=-1) > _WHITE
    height, width = clip.source_size[frame]
    if abs(picture.shape[0] * width - picture.shape[1] * height) > max(picture.shape):  # half a pixel is no other shape
        raise ClipError(
            f"mask {path.name} is {picture.shape[1]} x {picture.shape[0]} and its frame {width} x {height}; "
            "expected the same shape"
        )
    H, W = clip.images.shape[1:3]
    columns, rows = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    left, top, right, bottom = clip.valid_box[frame]
    inside = (columns > left) & (columns < right) & (rows > top) & (rows < bottom)
    places = clip.to_source(frame, np.stack([columns, rows], axis=-1)) / [width, height]  # in [0, 1]
    x, y = (np.clip(places[..., i] * picture.shape[1 - i], 0, picture.shape[1 - i] - 1).astype(int) for i in (0, 1))
    return picture[y, x] & inside
