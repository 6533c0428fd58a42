"""Depth maps and masks of a sequence: read when they are asked for, of their pictures' size. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Shaped

from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.pictures import PNG, opening, picture_size
from vggtjax.evaluation.datasets.sequence import DepthReader, MaskReader


def depth_reader(
    pictures: Sequence[Path], paths: Sequence[Path | None], read: Callable[[Path], Float32[np.ndarray, "h w"]]
) -> tuple[DepthReader | None, tuple[str, ...]]:
    """Return a reader of the frames' depth, and notes on frames without: their depth is 0, not known, throughout.

    The reader is None where no frame has depth. It raises InputError for maps that are not of their picture's size,
    and for files that cannot be read. What is not finite or not above 0 is not known, and becomes 0.
    """
    missing = [picture.stem for picture, path in zip(pictures, paths, strict=True) if path is None]
    if len(missing) == len(pictures):
        return None, ("it has no depth",)

    def depth(frame: int) -> Float32[np.ndarray, "h w"]:
        path = paths[frame]
        if path is None:
            width, height = picture_size(pictures[frame])
            return np.zeros((height, width), np.float32)
        values = _of_picture_size(read(path), path, pictures[frame])
        return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)

    if not missing:
        return depth, ()
    return depth, (f"{len(missing)} of {len(pictures)} frames have no depth, {missing[0]} first",)


def mask_reader(
    pictures: Sequence[Path], paths: Sequence[Path | None], read: Callable[[Path], Bool[np.ndarray, "h w"]]
) -> tuple[MaskReader | None, tuple[str, ...]]:
    """Return a reader of the frames' masks, or None and a note where some frame has none: nothing marks it unknown."""
    there = [path for path in paths if path is not None]
    if len(there) < len(pictures):
        return None, (f"{len(there) or 'none'} of {len(pictures)} frames have a mask, so it has no masks",)
    return lambda frame: _of_picture_size(read(there[frame]), there[frame], pictures[frame]), ()


def read_labels(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read a picture of labels: True where one is above 0, whether it is a palette's, a brightness or a colour.

    Raises InputError for a file that is no picture.
    """
    with opening(path, PNG) as image:
        labels = np.asarray(image)
        mode = image.mode
    if mode in ("LA", "RGBA"):
        labels = labels[..., :-1]  # opacity is no label
    above = np.asarray(labels > 0)
    return above if above.ndim == 2 else np.asarray(above.any(axis=2))


def _of_picture_size(values: Shaped[np.ndarray, "h w"], path: Path, picture: Path) -> Shaped[np.ndarray, "h w"]:
    width, height = picture_size(picture)
    if values.shape != (height, width):
        raise InputError(f"{path} has shape {values.shape}; expected {(height, width)}, the size of {picture.name}")
    return values
