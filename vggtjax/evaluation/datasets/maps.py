"""Readers of the depth maps and masks of a sequence, at their pictures' size. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Shaped

from vggtjax.captures.pictures import PNG, opening, picture_size
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.sequence import DepthReader, MaskReader


def depth_reader(
    pictures: Sequence[Path], paths: Sequence[Path | None], read: Callable[[Path], Float32[np.ndarray, "h w"]]
) -> tuple[DepthReader | None, tuple[str, ...]]:
    """Return a reader of the frames' depth, 0 where it is unknown, and notes on frames without depth.

    The reader is None if no frame has depth. It raises InputError for unreadable files and for maps of another size
    than their picture. Depth that is not finite or not above 0 counts as unknown.
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
    """Return a reader of the frames' masks, or None and a note unless every frame has a mask."""
    masks = [path for path in paths if path is not None]
    if len(masks) < len(pictures):
        return None, (f"{len(masks) or 'none'} of {len(pictures)} frames have a mask, so it has no masks",)
    return lambda frame: _of_picture_size(read(masks[frame]), masks[frame], pictures[frame]), ()


def read_labels(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read a picture of labels (palette, brightness or colour): True where a label is above 0.

    Raises InputError for any other file.
    """
    with opening(path, PNG) as image:
        labels = np.asarray(image)
        mode = image.mode
    if mode in ("LA", "RGBA"):
        labels = labels[..., :-1]  # without opacity
    above = np.asarray(labels > 0)
    return above if above.ndim == 2 else np.asarray(above.any(axis=2))


def _of_picture_size(values: Shaped[np.ndarray, "h w"], path: Path, picture: Path) -> Shaped[np.ndarray, "h w"]:
    width, height = picture_size(picture)
    if values.shape != (height, width):
        raise InputError(f"{path} has shape {values.shape}; expected {(height, width)}, the size of {picture.name}")
    return values
