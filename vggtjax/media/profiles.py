"""Pictures with an ICC profile, such as Display P3 and Adobe RGB, as sRGB: by Little CMS. Does not import jax."""

from __future__ import annotations

import functools
import io
from typing import NamedTuple

from PIL import Image, ImageCms

from vggtjax.errors import one_line

_MOST_BYTES = 1 << 22  # of a profile; those of printers have 1 to 3 MB
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}  # Pillow's mode by the profile's colour space


class Profile(NamedTuple):
    """What an ICC profile does to the pictures that have it."""

    note: str | None  # in words; None for sRGB, whose pictures stay as they are
    mode: str = "RGB"  # of the pictures that it describes
    transform: ImageCms.ImageCmsTransform | None = None  # to sRGB in RGB


def profile_of(image: Image.Image) -> Profile:
    """Return the profile of an opened picture; a broken one, and one of another colour space, changes nothing."""
    stored = image.info.get("icc_profile")
    return _read(stored) if isinstance(stored, bytes) and stored else Profile(None)


def in_srgb(image: Image.Image) -> Image.Image:
    """Return a picture whose profile describes its mode as RGB in sRGB, and others as they are."""
    profile = profile_of(image)
    if profile.transform is None or image.mode != profile.mode:
        return image
    return ImageCms.applyTransform(image, profile.transform) or image


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
        if "srgb" in name.lower():
            return Profile(None)
        how = {"renderingIntent": ImageCms.Intent.RELATIVE_COLORIMETRIC, "flags": ImageCms.Flags.BLACKPOINTCOMPENSATION}
        transform = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), _MODES[space], "RGB", **how)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        return Profile(unread.format(one_line(str(error), 60)))
    return Profile(f"has the colour profile {name!r}; its colours are converted to sRGB", _MODES[space], transform)
