"""Pictures with an ICC profile, such as Display P3 and Adobe RGB, as sRGB: by Little CMS. Does not import jax."""

from __future__ import annotations

import functools
import io
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageCms

from vggtjax.errors import one_line

_MOST_BYTES = 1 << 22  # of a profile; those of printers have 1 to 3 MB
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}  # Pillow's mode by the profile's colour space
_PROBES = np.array([[0, 0, 0], [255, 255, 255], [60, 170, 70], [200, 40, 40], [40, 60, 200], [90, 90, 90]], np.uint8)
_SAME = 2  # of 255: what sRGB's own profiles, of several makers, move the probes by


class Profile(NamedTuple):
    """What an ICC profile does to the pictures that have it."""

    note: str | None = None  # in words; None where the pictures stay as they are
    mode: str = "RGB"  # of the pictures that it describes
    transform: ImageCms.ImageCmsTransform | None = None  # to sRGB in RGB


def profile_of(image: Image.Image) -> Profile:
    """Return the profile of an opened picture; a broken one, and one of another kind of picture, changes nothing."""
    stored = image.info.get("icc_profile")
    return _read(stored) if isinstance(stored, bytes) and stored else Profile()


def in_srgb(image: Image.Image) -> tuple[Image.Image, str | None]:
    """Return a picture in L, RGB or CMYK as RGB in sRGB by its profile, and what was done, in words."""
    profile = profile_of(image)
    if profile.transform is not None and profile.mode == "RGB" and image.mode == "L":
        image = image.convert("RGB")  # equal channels in the space of the profile
    if profile.transform is None:
        return image.convert("RGB"), profile.note
    if image.mode != profile.mode:
        return image.convert("RGB"), f"is {image.mode} and its colour profile is of {profile.mode}; it is not used"
    return ImageCms.applyTransform(image, profile.transform) or image, profile.note


@functools.lru_cache(maxsize=8)  # all pictures of a clip have one
def _read(stored: bytes) -> Profile:
    unread = "has a colour profile that cannot be read ({}); its colours are read as sRGB"
    if len(stored) > _MOST_BYTES:
        return Profile(unread.format(f"{len(stored)} bytes"))
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(stored))
        name = one_line(ImageCms.getProfileDescription(profile) or "no name", 60)
        space = str(profile.profile.xcolor_space).strip()  # pyright: ignore[reportAttributeAccessIssue]: Pillow's stub
        if space not in _MODES:
            return Profile(unread.format(f"colour space {one_line(space, 8)}"))
        how = {"renderingIntent": ImageCms.Intent.RELATIVE_COLORIMETRIC, "flags": ImageCms.Flags.BLACKPOINTCOMPENSATION}
        transform = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), _MODES[space], "RGB", **how)
        if space != "CMYK" and _is_srgb(transform, _MODES[space]):
            return Profile(mode=_MODES[space])
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        return Profile(unread.format(one_line(str(error), 60)))
    return Profile(f"has the colour profile {name!r}; its colours are converted to sRGB", _MODES[space], transform)


def _is_srgb(transform: ImageCms.ImageCmsTransform, mode: str) -> bool:
    """Return whether a transform to sRGB leaves colours as they are, whatever its profile is called."""
    probes = Image.fromarray(_PROBES[None]).convert(mode)
    moved = np.asarray(ImageCms.applyTransform(probes, transform)).astype(int) - np.asarray(probes.convert("RGB"))
    return bool(np.abs(moved).max() <= _SAME)
