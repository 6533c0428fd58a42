"""Image files as upright 8-bit RGB frames. Does not import jax."""

from __future__ import annotations

import functools
import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pi_heif
from PIL import Image, ImageFile, ImageOps, UnidentifiedImageError

from vggtjax.clips.media.arrays import eight_bit
from vggtjax.clips.media.colour import HDR, WIDE, srgb_of_coded
from vggtjax.clips.media.order import in_order
from vggtjax.clips.media.profiles import in_srgb, profile_of
from vggtjax.clips.media.sampling import Frame, Sampling
from vggtjax.clips.media.times import FrameTimes, frame_times
from vggtjax.errors import ClipError, InputError, check_regular

logger = logging.getLogger(__name__)

# Formats of still pictures only: for others (EPS) Pillow starts another program.
FORMATS = ("PNG", "JPEG", "MPO", "TIFF", "BMP", "PPM", "WEBP", "TGA", "JPEG2000", "AVIF", "HEIF")

# A picture of one colour takes a byte for at most about so many pixels (of one bit), and so many are never doubted; a
# shorter file makes Pillow take memory in vain. Formats that are not in the table shrink one colour to almost nothing.
_MOST_PIXELS_A_BYTE, _ALWAYS_PIXELS = 10_000, 2**24
_LITTLE_SHRUNK: dict[str, int] = dict.fromkeys(("PNG", "JPEG", "MPO", "BMP", "PPM", "TGA"), 2**22)

ORIENTATION = 0x0112  # of EXIF; from 5 on, width and height are swapped
_PANORAMA = "is a panorama of 360 degrees (equirectangular), and the network knows pictures of plain lenses"
_MOST_XMP = 1 << 16  # bytes
_DARK = 16  # of 255: the most that a picture of 12 bits has when it is stored in 16
_SEVERAL = ("MPO",)  # formats whose further pictures are previews of the first

# What Pillow's decoders raise on broken files; its size limit is DecompressionBombError.
UNREADABLE = (
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, RuntimeError, EOFError, OverflowError, MemoryError),
    *(struct.error, Image.DecompressionBombError),
)


@dataclass(frozen=True)
class ImageFiles:
    """Image files, one frame each, named by the stem of the file; of a file with several pictures the first."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = field(default=(), kw_only=True, compare=False)  # what is odd about the choice of files
    _said: set[str] = field(default_factory=set, init=False, repr=False, compare=False)  # kinds of warnings, each once

    @property
    def name(self) -> str:
        """The folder's name, or that of a single image."""
        path = self.paths[0].absolute()
        return path.stem if len(self.paths) == 1 else path.parent.name

    @property
    def frame_names(self) -> tuple[str, ...]:
        """The names of all frames."""
        return tuple(path.stem for path in self.paths)

    @functools.cached_property
    def times(self) -> FrameTimes | None:
        """The times that the files state; see `stated_times`."""
        return stated_times(self.paths)

    def total(self, sampling: Sampling) -> int:
        """Return how many frames `sampling` takes."""
        return len(self.taken(sampling))

    def taken(self, sampling: Sampling) -> Sequence[int]:
        """Return the indices of the files that `sampling` takes, with `fps` by their times."""
        if sampling.fps is None or self.times is None:
            return sampling.indices(len(self.paths))
        return [index for index, _, _ in sampling.select((float(time), None) for time in self.times.from_first)]

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes. Raises ClipError for a file that cannot be read."""
        times = None if self.times is None else self.times.from_first
        for index in self.taken(sampling):
            path = self.paths[index]
            time = None if times is None else float(times[index])
            yield Frame(path.stem, read_image(path, self._said), time, index=index)


def stated_times(paths: Sequence[Path]) -> FrameTimes | None:
    """Return the times of picture files by a list beside or above them, or by their names; see `frame_times`."""
    pictures: list[str] = []
    if len({path.parent for path in paths}) == 1 and (folder := paths[0].parent).is_dir():
        found = (path for path in folder.iterdir() if is_image_name(path) and not path.name.startswith("."))
        pictures = [path.name for path in in_order(found)]
    return frame_times(paths, pictures)


def is_image_name(path: Path) -> bool:
    """Return whether the name ends as that of an image file does."""
    return path.suffix.lower() in _suffixes()


def read_image(path: Path, said: set[str] | None = None) -> Image.Image:
    """Read an image file as upright RGB.

    The orientation of its EXIF data is applied, colours are converted to sRGB by its ICC profile, transparency is
    composited over white, 16-bit values are scaled to 8 bits and floating-point values must lie in [0, 1]. With `said`,
    the kinds of warnings that were given, pictures that use few of their bits or have others behind them are warned of.

    Raises ClipError for a file that is missing, empty, no image, truncated, corrupt, above Pillow's limit of pixels, or
    too short for the pixels that it says it has.
    """
    check_regular(path, ClipError)
    try:
        check_not_empty(path)
        with Image.open(path, formats=known_formats()) as image:
            check_pixels(image, path)
            is_deep, count = _has_sixteen_bits(image), 1 if image.format in _SEVERAL else getattr(image, "n_frames", 1)
            upright, coded = ImageOps.exif_transpose(image), image.info.get("nclx_profile")
            picture, note = _by_code(upright, path, coded) if coded else (None, None)
            if picture is None:
                picture = to_rgb(upright, path.name, said)
        if said is not None and note is not None:
            _say(path.name, note, "colours", said)
        if said is not None and count > 1:
            _say(path, f"holds {count} pictures; the first is read, write the others as files", "several", said)
        if said is not None and _is_panorama(image):
            _say(path, f"{_PANORAMA}; cut views out of it, such as with FFmpeg's v360=e:flat", "panorama", said)
        if said is not None and is_deep and 0 < np.asarray(picture).max() <= _DARK:
            bits = "has 16 bits a value and uses at most 12 of them, so it is nearly black; if all pictures are"
            _say(path, f"{bits}, multiply their values by 16 (for 12 bits) or 64 (for 10)", "deep", said)
        return picture
    except ClipError:
        raise
    except FileNotFoundError as error:
        raise ClipError(f"image {path} does not exist; check the path") from error
    except UnidentifiedImageError as error:
        raise ClipError(f"{path} is not an image of a known format; expected one of {', '.join(FORMATS)}") from error
    except UNREADABLE as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ClipError(f"cannot read image {path}: {reason}; leave it out or write it anew") from error


def _by_code(picture: Image.Image, path: Path, coded: Any) -> tuple[Image.Image | None, str | None]:
    """Return a HEIF file as sRGB by the code of colours that it states, and what was done.

    None for plain colours, and for wide ones with an ICC profile. The file is read again for its 10 or 12 bits, of
    which Pillow's pictures have 8.
    """
    transfer, primaries = (int(coded[name]) for name in ("transfer_characteristics", "color_primaries"))
    if transfer not in HDR and (primaries not in WIDE or profile_of(picture).note):
        return None, None
    file = pi_heif.open_heif(path, convert_hdr_to_8bit=False)
    deep = np.array(file)  # a copy: a view does not keep the file's memory
    if deep.dtype != np.uint16:
        deep = np.asarray(to_rgb(picture, path.name)).astype(np.uint16) * np.uint16(257)
    pixels, note = srgb_of_coded(deep[..., :3], transfer, primaries)
    return Image.fromarray(pixels), note


def _is_panorama(image: Image.Image) -> bool:
    """Return whether XMP data say that a picture shows the whole sphere (Google's Photo Sphere metadata)."""
    xmp = image.info.get("xmp", b"")
    return b"equirectangular" in (xmp if isinstance(xmp, bytes) else str(xmp).encode())[:_MOST_XMP]


def _say(path: Path | str, note: str, kind: str, said: set[str]) -> None:
    """Log what is odd about a picture, once for all of a kind."""
    if kind not in said:
        said.add(kind)
        logger.warning("%s %s", path, note)


def check_not_empty(path: Path) -> None:
    """Raise ClipError for a file without bytes."""
    if path.stat().st_size == 0:
        raise ClipError(f"{path} is empty (0 bytes); get it whole, or leave it out")


def stored_orientation(path: Path) -> int:
    """Return EXIF's orientation of the stored pixels, 1 for pictures that are stored upright or cannot be read."""
    with suppress(*UNREADABLE), Image.open(path, formats=known_formats()) as image:
        return int(image.info.get("original_orientation") or image.getexif().get(ORIENTATION, 1))  # of HEIF, of others
    return 1


def turned(values: np.ndarray, orientation: int) -> np.ndarray:
    """Return stored values [H, W] as they are shown with an orientation of EXIF, a view [H, W] or [W, H]."""
    if orientation in (5, 6, 7, 8):  # across the diagonal
        values = values.T
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    return values[::-1] if orientation in (3, 4, 7, 8) else values


def check_pixels(image: Image.Image, path: Path, error: type[InputError] = ClipError) -> None:
    """Raise `error` for an opened picture that says it has more pixels than a file of its size can honestly hold."""
    pixels, size = image.width * image.height, path.stat().st_size
    if pixels > max(_LITTLE_SHRUNK.get(image.format or "", _ALWAYS_PIXELS), _MOST_PIXELS_A_BYTE * size):
        raise error(f"{path} has {size} bytes and says it has {image.width} x {image.height} pixels; get it whole")


def has_transparency(image: Image.Image) -> bool:
    """Return whether a picture can be transparent; one of a palette that is missing cannot, and Pillow fails there."""
    is_bare = image.mode == "P" and image.palette is None and "transparency" not in image.info
    return not is_bare and image.has_transparency_data


def to_rgb(image: Image.Image, name: str, said: set[str] | None = None) -> Image.Image:
    """Return an image of any mode and ICC profile as RGB in sRGB, as `read_image` does; errors and warnings say `name`.

    With `said`, the kinds of warnings that were given, what becomes of its colours is warned of.
    """
    stored = image
    if image.mode == "I" or image.mode == "F" or image.mode.startswith("I;16"):
        values = np.asarray(image)
        if image.mode == "I":  # 32 bits that hold 16
            if values.min() < 0 or values.max() > 65535:
                raise ClipError(f"frame {name} has values from {values.min()} to {values.max()}; expected 16 bits")
            values = values.astype(np.uint16)
        image = Image.fromarray(eight_bit(values, name))
    elif has_transparency(image):  # white is white in sRGB, too
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
        image = image.convert("L" if stored.mode == "LA" else "RGB")
    elif image.mode not in ("L", "CMYK"):
        image = image.convert("RGB")
    image.info = stored.info
    image, note = in_srgb(image)
    if said is not None and note is not None:
        _say(name, note, "colours", said)
    return image


def _has_sixteen_bits(image: ImageFile.ImageFile) -> bool:
    """Return whether an opened picture, not loaded yet, stores 16 bits a value; Pillow takes 8 of those of colours."""
    return ";16" in image.mode or any(";16" in str(tile[3]) for tile in image.tile)


@functools.cache
def known_formats() -> tuple[str, ...]:
    """Return the FORMATS that this Pillow can read, HEIF by pi-heif; files in other formats are refused."""
    Image.init()
    pi_heif.register_heif_opener()
    return tuple(name for name in FORMATS if name in Image.OPEN)


@functools.cache
def _suffixes() -> frozenset[str]:
    known_formats()
    return frozenset(suffix for suffix, name in Image.registered_extensions().items() if name in FORMATS)
