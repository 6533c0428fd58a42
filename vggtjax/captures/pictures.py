"""Stored pictures of a data set: depth, labels, sizes. Does not import jax."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from vggtjax.clips.images import UNREADABLE, check_pixels, known_formats
from vggtjax.errors import InputError, check_regular

PNG = ("PNG",)
_ORIENTATION = 0x0112  # EXIF; from 5 on, width and height are swapped
_FIRST_TURNED = 5
_SAME_SIDES = (2, 3, 4)  # turned or mirrored, with width and height as they were
_BROKEN = (*UNREADABLE, Image.DecompressionBombWarning)


@contextmanager
def opening(path: Path, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """Open a picture without turning it; raises InputError for any other file, also while it is decoded."""
    check_regular(path)
    try:
        with Image.open(path, formats=formats) as image:
            check_pixels(image, path, InputError)
            yield image
    except InputError:
        raise
    except _BROKEN as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"{path} cannot be read: {reason}; expected {' or '.join(formats)}, whole") from error


def picture_size(path: Path) -> tuple[int, int]:
    """Return width and height of an upright picture; raises InputError for any other file."""
    with opening(path, known_formats()) as image:
        width, height = image.size
        return (height, width) if image.getexif().get(_ORIENTATION, 1) >= _FIRST_TURNED else (width, height)


def has_unclear_pixels(path: Path) -> bool:
    """Return whether a picture is stored mirrored or upside down, at the size of the upright one.

    Raises InputError for any other file.
    """
    with opening(path, known_formats()) as image:
        return image.getexif().get(_ORIENTATION, 1) in _SAME_SIDES
