"""Stored pictures of a data set: depth, labels, sizes. Does not import jax."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from vggtjax.clips.media.images import ORIENTATION, UNREADABLE, check_pixels, known_formats
from vggtjax.errors import InputError, check_regular

PNG = ("PNG",)
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


def picture_size(path: Path, *, with_camera: bool = False) -> tuple[int, int]:
    """Return width and height of an upright picture.

    Raises InputError for any other file and, `with_camera`, for a picture that is stored upside down or mirrored.
    """
    with opening(path, known_formats()) as image:
        orientation, (width, height) = image.getexif().get(ORIENTATION, 1), image.size
    if with_camera and orientation in _SAME_SIDES:
        raise InputError(
            f"{path} is stored upside down or mirrored (its EXIF orientation), and its camera may count the stored "
            "pixels or the shown ones; write the pictures upright, and make the cameras anew"
        )
    return (height, width) if orientation >= _FIRST_TURNED else (width, height)
