"""Frames that are no part of the scene: without content, flashes, and cuts to another shot. Does not import jax."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from PIL import Image

from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.media.sampling import Frame, Sampling, Source
from vggtjax.errors import ClipError

logger = logging.getLogger(__name__)

_SIDE = 32  # pixels of a thumbnail
_SHIFTS = (-8, -4, 0, 4, 8)  # of thumbnails, as a camera turns
_BINS = 8  # of each channel
_GREYS = 32  # bins of brightness
_FLAT = 8  # of 255: the largest range of a channel in a frame without content, coarser than noise
_DARK = 4095 / 65535  # white, where 12 bits are stored in 16
_FLASH = 0.2  # brightness above the frames before and after, which are as bright as each other within half of it
_LONGEST_FLASH = 3  # frames
# A cut: colours or brightness are spread otherwise (Hellinger's distance, squared), or thumbnails are less alike under
# every shift, by so much more than between most frames of the clip; and they are not very alike. Colours of filmed
# neighbours have up to .02, of a fast camera at few frames a second .20 with a median of .11; of two clips .13 to .8.
_OTHERWISE, _TIMES_MEDIAN, _UNLIKE = np.array([0.1, 0.1, 0.4]), 3.0, 0.3


class Look(NamedTuple):
    """What tells one frame from another."""

    is_blank: bool
    brightness: float
    thumbnail: Float32[np.ndarray, "32 32"]
    spreads: tuple[Float[np.ndarray, " bins"], ...]  # of colours, of brightness: shares of the pixels


class Shots(NamedTuple):
    """Positions of a clip's frames."""

    blank: tuple[int, ...]  # without content: of one colour
    flashes: tuple[int, ...]
    shots: tuple[range, ...]  # of the frames from cut to cut, blank ones at their ends left out


def look_at(picture: Image.Image) -> Look:
    """Return the look of an RGB picture."""
    pixels = np.asarray(picture.resize((2 * _SIDE, 2 * _SIDE), Image.Resampling.BOX))
    grey = pixels.astype(np.float32).mean(axis=-1)
    codes = (pixels // (256 // _BINS)).astype(int) @ (_BINS**2, _BINS, 1), (grey * (_GREYS / 256)).astype(int)
    spreads = tuple(
        np.bincount(code.ravel(), minlength=bins) / code.size
        for code, bins in zip(codes, (_BINS**3, _GREYS), strict=True)
    )
    thumbnail = grey.reshape(_SIDE, 2, _SIDE, 2).mean(axis=(1, 3)) / 255
    return Look(bool(np.ptp(pixels, axis=(0, 1)).max() <= _FLAT), float(grey.mean() / 255), thumbnail, spreads)


def looks_of(images: Float32[np.ndarray, "S H W 3"], boxes: Int[np.ndarray, "S 4"]) -> list[Look]:
    """Return the look of each frame of a clip, by the pixels that are not padding."""
    return [look_at(Image.fromarray(in_bytes(picture))) for picture in _inside(images, boxes)]


def _inside(images: np.ndarray, boxes: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the pixels of each frame that are not padding."""
    for image, (left, top, right, bottom) in zip(images, boxes, strict=True):
        yield image[top:bottom, left:right]


def find_shots(looks: Sequence[Look]) -> Shots:
    """Return what is no part of the scene, and the shots; a clip of a few pictures from afar has no cuts."""
    blank = tuple(i for i, look in enumerate(looks) if look.is_blank)
    kept = [i for i, look in enumerate(looks) if not look.is_blank]
    flashes = _bright_runs(looks, kept)
    kept = [i for i in kept if i not in flashes]
    if not kept:
        return Shots(blank, tuple(sorted(flashes)), ())
    distances = [_distances(looks[a], looks[b]) for a, b in itertools.pairwise(kept)]
    bound = _OTHERWISE + _TIMES_MEDIAN * np.median(distances, axis=0) if distances else np.ones(3)
    parts = [[kept[0]]]
    for b, distance in zip(kept[1:], distances, strict=True):
        if (distance > bound).any() and distance[-1] > _UNLIKE:
            parts.append([])
        parts[-1].append(b)
    joined = parts[:1]
    for part in parts[1:]:  # the scene comes back after a moment: what lay between was no shot
        before = joined[-2][-1] if len(joined) > 1 else None
        if (
            before is not None
            and len(joined[-1]) <= _LONGEST_FLASH
            and (_distances(looks[before], looks[part[0]]) <= bound).all()
        ):
            flashes.update(joined.pop())
            joined[-1].extend(part)
        else:
            joined.append(part)
    return Shots(blank, tuple(sorted(flashes)), tuple(range(part[0], part[-1] + 1) for part in joined))


def warn_of_dark(images: Float32[np.ndarray, "S H W 3"], boxes: Int[np.ndarray, "S 4"]) -> None:
    """Log that all frames are nearly black, as where their values were stored in more bits or divided twice."""
    brightest = max(float(picture.max()) for picture in _inside(images, boxes))
    if 0 < brightest <= _DARK:
        logger.warning(
            "the brightest pixel of all frames has %.1f of 255, and the model sees little in the dark; where 8, 10 or "
            "12 bits were stored in 16, or bytes divided by 255 twice, scale the values, so that white is the largest",
            255 * brightest,
        )


class ShotWatch:
    """Says what is no part of a clip's scene while its frames are read, each finding once."""

    def __init__(self, sampling: Sampling) -> None:
        self.looks: list[Look] = []
        self.numbers: list[int] = []  # of the frames in the source
        self._sampling = sampling
        self._said = Shots((), (), ())
        self._due = 0  # frames, before the next look over all

    def over(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames, and look at each."""
        for position, frame in enumerate(frames):
            self.looks.append(look_at(frame.image))
            self.numbers.append(position if frame.index is None else frame.index)
            yield frame

    def warn_early(self) -> None:
        """Do as `warn` where twice as many frames have been seen as at the last time."""
        if len(self.looks) >= self._due:
            self._due = 2 * len(self.looks)
            self.warn()

    def warn(self) -> Shots:
        """Log what was found since the last call, by numbers of the source's frames, and what to do; return all."""
        found = find_shots(self.looks)
        for positions, said, what in (
            (found.blank, self._said.blank, "of one colour: without depth, and bad for the cameras of the others"),
            (found.flashes, self._said.flashes, "unlike those before and after, as a flash is: bad for the cameras"),
        ):
            if set(positions) - set(said) and len(positions) < len(self.looks):
                numbers = as_ranges([self.numbers[i] for i in positions])
                are = f"frame {numbers} is" if len(positions) == 1 else f"frames {numbers} are"
                skip = self.skip([self.numbers[i] for i in positions])
                logger.warning("%s %s; leave out with --skip %s", are, what, skip)
        if len(found.shots) > max(1, len(self._said.shots)):
            spans = [f"{self.numbers[shot[0]]}-{self.numbers[shot[-1]]}" for shot in found.shots]
            shown = ", ".join([*spans[:5], *(["..."] if len(spans) > 5 else [])])
            first = found.shots[1]
            logger.warning(
                "the clip has %d shots: frames %s; their places would be mixed into one: --shots split makes a result "
                "of each, or take one, such as with --start %d --max-frames %d",
                len(spans), shown, self.numbers[first[0]], len(first),
            )  # fmt: skip
        self._said = found
        return found

    def skip(self, numbers: Sequence[int]) -> str | None:
        """Return the frames to leave out, with those that are left out already, as `Sampling.skip`."""
        parts = [self._sampling.skip, as_ranges(numbers)]
        return ",".join(part for part in parts if part) or None


def shot_samplings(source: Source, sampling: Sampling) -> list[Sampling]:
    """Return what takes each shot of a source, without frames of one colour and flashes; reads the source once.

    Raises ClipError where no frame is left.
    """
    watch = ShotWatch(sampling)
    for _ in watch.over(source.frames(sampling)):
        pass
    found = watch.warn()
    left_out = {*found.blank, *found.flashes}
    skip = watch.skip([watch.numbers[i] for i in sorted(left_out)])
    if not found.shots:
        raise ClipError(
            f"all {len(watch.looks)} frames are of one colour; expected a clip in which something can be seen"
        )
    return [
        Sampling(watch.numbers[shot[0]], sampling.stride, sampling.fps, len(set(shot) - left_out), skip)
        for shot in found.shots
    ]


def as_ranges(numbers: Sequence[int]) -> str:
    """Return numbers in order as text: 0-2,17."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts)


def _bright_runs(looks: Sequence[Look], kept: Sequence[int]) -> set[int]:
    """Return frames that are brighter than those before and after, or than one side at an end of the clip."""
    bright = [looks[i].brightness for i in kept]
    found: set[int] = set()
    for length in range(1, _LONGEST_FLASH + 1):
        for first in range(len(kept) - length + 1):
            run, end = range(first, first + length), first + length
            beside = bright[max(first - 1, 0) : first] + bright[end : end + 1]
            if len(beside) < 2 and len(kept) < 2 * length + 2:  # too few to tell which are the odd ones
                continue
            if min(bright[i] for i in run) > _FLASH + max(beside) and max(beside) - min(beside) < _FLASH / 2:
                found.update(kept[i] for i in run)
    return found


def _distances(a: Look, b: Look) -> Float[np.ndarray, " 3"]:
    """Return how differently colours and brightness are spread, and how unlike the thumbnails are."""
    spreads = [1 - np.sqrt(x * y).sum() for x, y in zip(a.spreads, b.spreads, strict=True)]
    likeness = max(_correlation(a.thumbnail, b.thumbnail, y, x) for y in _SHIFTS for x in _SHIFTS)
    return np.array([*spreads, 1 - likeness])


def _correlation(a: np.ndarray, b: np.ndarray, y: int, x: int) -> float:
    own = a[max(0, y) : _SIDE + min(0, y), max(0, x) : _SIDE + min(0, x)]
    other = b[max(0, -y) : _SIDE + min(0, -y), max(0, -x) : _SIDE + min(0, -x)]
    own, other = own - own.mean(), other - other.mean()
    return float((own * other).sum() / np.sqrt((own**2).sum() * (other**2).sum() + 1e-6))
