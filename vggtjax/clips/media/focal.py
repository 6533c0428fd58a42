"""The focal length that a camera writes into its pictures (EXIF) and videos (QuickTime). Does not import jax.

Two statements are read. EXIF's FocalLengthIn35mmFilm, and QuickTime's key of the same meaning, is the focal length that
sees as much on film of 36 x 24 mm. EXIF does not say in which direction; the guideline DCG-001 of CIPA, the makers of
cameras, says along the diagonal: pixels = millimetres * the picture's diagonal in pixels / 43.27 mm. COLMAP reads it
so, too. By the width it would be 4 % less for pictures of 4:3, and 5 % more for 16:9. Such a value tells what the
picture shows, so that digital zoom is part of it. Where it is missing, EXIF's FocalLength in millimetres times
FocalPlaneXResolution in pixels per unit is taken; that tells of the lens and the sensor, so it is multiplied by
DigitalZoomRatio.
"""

from __future__ import annotations

import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from vggtjax.clips.media.images import UNREADABLE, known_formats
from vggtjax.errors import InputError, one_line

FOCAL_RANGE = (0.1, 50.0)  # of a focal length, in long sides of the picture
_FILM_DIAGONAL = math.hypot(24, 36)  # mm
_SUBFOLDER = 0x8769  # of the camera's own tags
_FOCAL, _FOCAL_35, _ZOOM = 0x920A, 0xA405, 0xA404
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_WIDTH, _HEIGHT = 0xA002, 0xA003  # of the picture when it was taken
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # mm; the last two are not EXIF's, but written
_MOST_ZOOM = 200.0
_QUICKTIME = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


class StatedFocal(NamedTuple):
    """A focal length in pixels of the upright picture, and how the file states it."""

    pixels: float
    words: str


def picture_focal(path: Path) -> StatedFocal:
    """Return the focal length that an image file states, in pixels of the picture as the file has it.

    Raises InputError, in one sentence, where it states none, one that no camera has, or where the picture was cut since
    it was taken: then neither its field of view nor its middle is known.
    """
    tags: dict[int, Any] = {}
    size = (0, 0)
    with warnings.catch_warnings(), suppress(*UNREADABLE):
        warnings.simplefilter("ignore")  # of broken tags, which count as missing
        with Image.open(path, formats=known_formats()) as image:
            size = image.size
            tags = dict(image.getexif().get_ifd(_SUBFOLDER))
    film, focal, plane = (_number(tags.get(tag)) for tag in (_FOCAL_35, _FOCAL, _PLANE_X))
    if not max(film, focal):
        raise InputError(f"{path} states no focal length in its EXIF data; give fx,fy,cx,cy or a file of them")
    taken = tuple(int(_number(tags.get(tag))) for tag in (_WIDTH, _HEIGHT))
    taken = taken if min(taken) > 0 else size
    if abs(max(taken) * min(size) - max(size) * min(taken)) > max(taken + size):  # more than one pixel of rounding
        raise InputError(
            f"{path} is {size[0]} x {size[1]} and was {taken[0]} x {taken[1]} when it was taken, by its EXIF data, so "
            "it was cut and its focal length tells nothing; give fx,fy,cx,cy or the picture as it was taken"
        )
    if film:
        return _of_film(film, size, path)
    unit = _UNITS.get(int(_number(tags.get(_PLANE_UNIT, 2))), 0)
    if not plane or not unit:
        raise InputError(
            f"{path} states a focal length of {focal:g} mm and no size of the sensor in its EXIF data; expected the 35 "
            "mm equivalent or the focal plane's resolution, so give fx,fy,cx,cy"
        )
    zoom = _number(tags.get(_ZOOM))
    zoom = zoom if 1 < zoom < _MOST_ZOOM else 1.0  # 0: no digital zoom
    pixels = focal * plane / unit * zoom * max(size) / max(taken)
    zoomed = f", {zoom:g} times of digital zoom" if zoom != 1 else ""
    return _checked(StatedFocal(pixels, f"{focal:g} mm, {plane / unit:.4g} pixels per mm{zoomed}"), size, path)


def video_focal(path: Path, tags: dict[str, str], size: tuple[int, int]) -> StatedFocal:
    """Return the focal length that a video's metadata states, in pixels of its frames of (width, height).

    Raises InputError as `picture_focal`.
    """
    if (text := tags.get(_QUICKTIME)) is None:
        raise InputError(f"{path} states no focal length in its metadata; give fx,fy,cx,cy or a file of them")
    if not (film := _number(text)):
        raise InputError(f"{path} states a focal length of {one_line(text, 40)!r}; expected millimetres above 0")
    return _of_film(film, size, path)


def _of_film(film: float, size: tuple[int, int], path: Path) -> StatedFocal:
    stated = StatedFocal(film * math.hypot(*size) / _FILM_DIAGONAL, f"{film:g} mm as on 35 mm film")
    return _checked(stated, size, path)


def _checked(stated: StatedFocal, size: tuple[int, int], path: Path) -> StatedFocal:
    low, high = (share * max(size) for share in FOCAL_RANGE)
    if not low <= stated.pixels <= high:
        raise InputError(
            f"{path} states a focal length of {stated.words}, {stated.pixels:.4g} pixels of {size[0]} x {size[1]}; "
            f"expected {low:g} to {high:g}, so give fx,fy,cx,cy"
        )
    return stated


def _number(value: Any) -> float:
    """Return a finite number above 0, and 0 for anything else: EXIF's 0 is unknown, and 1/0 is what some write."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return 0.0
    return number if 0 < number < math.inf else 0.0
