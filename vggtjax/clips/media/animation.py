"""Frames of an animated WebP, PNG or AVIF, by their times. Does not import jax."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageOps

from vggtjax.clips.media.arrays import frame_name
from vggtjax.clips.media.images import UNREADABLE, check_pixels, known_formats, to_rgb
from vggtjax.clips.media.sampling import Frame, Sampling, before_it
from vggtjax.errors import ClipError

_FORMATS = ("WEBP", "PNG", "AVIF")  # of animations; GIF is a video
_LEAST_MS, _USUAL_MS = 10, 100  # shorter times are shown for the usual one, as browsers do


@dataclass(frozen=True)
class Animation:
    """An animated picture; frames are named by their index in it, and times count from its first frame."""

    path: Path

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.stem

    def total(self, sampling: Sampling) -> int | None:
        """Return how many frames `sampling` takes; None with `fps`, as only reading tells."""
        if sampling.fps is not None:
            return None
        with Image.open(self.path, formats=known_formats()) as image:
            return len(sampling.indices(_count(image)))

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes, upright and over white. Raises ClipError where the file breaks."""
        for index, time, picture in sampling.select(self._timed()):
            yield Frame(frame_name(index), picture, time, index=index)

    def _timed(self) -> Iterator[tuple[float, Image.Image]]:
        index = 0
        try:
            with Image.open(self.path, formats=known_formats()) as image:
                check_pixels(image, self.path)
                hidden, milliseconds, said = _hidden(image), 0.0, set[str]()
                for index in range(_count(image)):
                    image.seek(index + hidden)
                    picture = to_rgb(ImageOps.exif_transpose(image), self.path.name, said)
                    shown = float(image.info.get("duration", 0))  # known when the frame is loaded
                    yield milliseconds / 1000, picture
                    milliseconds += shown if shown > _LEAST_MS else _USUAL_MS
        except ClipError:
            raise
        except UNREADABLE as error:
            raise ClipError(f"{self.path} breaks off at frame {index} ({error}); {before_it(index)}") from error


def is_animation(path: Path) -> bool:
    """Return whether an image file holds several frames to be shown one after another; False for one that is broken."""
    with suppress(*UNREADABLE), Image.open(path, formats=known_formats()) as image:
        return image.format in _FORMATS and _count(image) > 1
    return False


def _hidden(image: Image.Image) -> int:
    """Return the number of pictures before the animation: a PNG may have one for programs that show no animations."""
    return int(bool(getattr(image, "default_image", False)))


def _count(image: Image.Image) -> int:
    return getattr(image, "n_frames", 1) - _hidden(image)
