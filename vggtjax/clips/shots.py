"""Frames that are no part of the scene: without content, flashes, and cuts to another shot. Does not import jax."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from PIL import Image

from vggtjax.media.sampling import Sampling, Source

logger = logging.getLogger(__name__)

_SIDE = 32  # pixels of a thumbnail
_SHIFTS = (-8, -4, 0, 4, 8)  # of thumbnails, as a camera turns
_BINS = 8  # of each channel
_FLAT = 0.04  # largest range of brightness, from the 2nd to the 98th percentile, of a frame without content
_DARK = 4095 / 65535  # white, where 12 bits are stored in 16
_FLASH = 0.2  # brightness above both neighbours, which are as bright as each other within half of it
_LONGEST_FLASH = 2  # frames
# A cut: colours differ (Hellinger's distance, squared) by so much more than between most frames of the clip, and no
# shift makes the thumbnails alike. Filmed neighbours have up to .02, of a fast camera at few frames a second .20 with a
# median of .11; frames of two clips have .13 to .8, and are never as alike.
_OTHER_COLOURS, _TIMES_MEDIAN, _ALIKE = 0.1, 3.0, 0.7


class Look(NamedTuple):
    """What tells one frame from another."""

    is_blank: bool
    brightness: float
    thumbnail: Float32[np.ndarray, "32 32"]
    colours: Float[np.ndarray, " 512"]  # shares of the pixels


class Shots(NamedTuple):
    """Positions of a clip's frames."""

    blank: tuple[int, ...]  # without content: of one colour
    flashes: tuple[int, ...]
    shots: tuple[range, ...]  # of the frames from cut to cut, blank ones at their ends left out


def look_at(picture: Image.Image) -> Look:
    """Return the look of an RGB picture."""
    small = picture.resize((2 * _SIDE, 2 * _SIDE), Image.Resampling.BOX)
    pixels = np.asarray(small)
    grey = pixels.astype(np.float32).mean(axis=-1) / 255
    low, high = np.percentile(grey, (2, 98))
    codes = (pixels // (256 // _BINS)).astype(int) @ (_BINS**2, _BINS, 1)
    shares = np.bincount(codes.ravel(), minlength=_BINS**3) / codes.size
    thumbnail = grey.reshape(_SIDE, 2, _SIDE, 2).mean(axis=(1, 3))
    return Look(bool(high - low < _FLAT), float(grey.mean()), thumbnail, shares)


def looks_of(images: Float32[np.ndarray, "S H W 3"], boxes: Int[np.ndarray, "S 4"]) -> list[Look]:
    """Return the look of each frame of a clip, by the pixels that are not padding."""
    pictures = (image[top:bottom, left:right] for image, (left, top, right, bottom) in zip(images, boxes, strict=True))
    return [look_at(Image.fromarray((255 * picture).astype(np.uint8))) for picture in pictures]


def find_shots(looks: Sequence[Look]) -> Shots:
    """Return what is no part of the scene, and the shots; a clip of a few pictures from afar has no cuts."""
    blank = tuple(i for i, look in enumerate(looks) if look.is_blank)
    kept = [i for i, look in enumerate(looks) if not look.is_blank]
    flashes = {
        b
        for a, b, c in zip(kept, kept[1:], kept[2:], strict=False)
        if looks[b].brightness > _FLASH + max(looks[a].brightness, looks[c].brightness)
        and abs(looks[a].brightness - looks[c].brightness) < _FLASH / 2
    }
    kept = [i for i in kept if i not in flashes]
    if not kept:
        return Shots(blank, tuple(sorted(flashes)), ())
    distances = [_distance(looks[a], looks[b]) for a, b in itertools.pairwise(kept)]
    bound = _OTHER_COLOURS + _TIMES_MEDIAN * float(np.median(distances)) if distances else 1.0
    parts = [[kept[0]]]
    for (a, b), distance in zip(itertools.pairwise(kept), distances, strict=True):
        if distance > bound and _likeness(looks[a], looks[b]) < _ALIKE:
            parts.append([])
        parts[-1].append(b)
    joined = parts[:1]
    for part in parts[1:]:  # the scene comes back after a moment: what lay between was no shot
        before = joined[-2][-1] if len(joined) > 1 else None
        if (
            before is not None
            and len(joined[-1]) <= _LONGEST_FLASH
            and _distance(looks[before], looks[part[0]]) <= bound
        ):
            flashes.update(joined.pop())
            joined[-1].extend(part)
        else:
            joined.append(part)
    return Shots(blank, tuple(sorted(flashes)), tuple(range(part[0], part[-1] + 1) for part in joined))


def warn_of_dark(images: Float32[np.ndarray, "S H W 3"], boxes: Int[np.ndarray, "S 4"]) -> None:
    """Log that all frames are nearly black, as where their values were stored in more bits or divided twice."""
    pictures = (image[top:bottom, left:right] for image, (left, top, right, bottom) in zip(images, boxes, strict=True))
    brightest = max(float(picture.max()) for picture in pictures)
    if 0 < brightest <= _DARK:
        logger.warning(
            "the brightest pixel of all frames has %.1f of 255, and the model sees little in the dark; where 8, 10 or "
            "12 bits were stored in 16, or bytes divided by 255 twice, scale the values, so that white is the largest",
            255 * brightest,
        )


def warn_of_shots(looks: Sequence[Look], names: Sequence[str], sampling: Sampling) -> Shots:
    """Log what is no part of the scene, by numbers of the source's frames, and what to do; return it."""
    found = find_shots(looks)
    number = numbers_of(names, sampling)
    for positions, what in (
        (found.blank, "{} of one colour: without depth, and bad for the cameras of the others"),
        (found.flashes, "{} unlike those before and after, as a flash is: bad for the cameras of the others"),
    ):
        if positions and len(positions) < len(looks):
            skipped = _as_ranges([number[i] for i in positions])
            are = f"frame {skipped} is" if len(positions) == 1 else f"frames {skipped} are"
            logger.warning("%s; leave out with --skip %s", what.format(are), skipped)
    if len(found.shots) > 1:
        spans = [f"{number[shot[0]]}-{number[shot[-1]]}" for shot in found.shots]
        shown = ", ".join([*spans[:5], *(["..."] if len(spans) > 5 else [])])
        first = found.shots[1]
        logger.warning(
            "the clip has %d shots: frames %s; their places would be mixed into one: --shots split makes a result of "
            "each, or take one, such as with --start %d --max-frames %d",
            len(spans), shown, number[first[0]], len(first),
        )  # fmt: skip
    return found


def numbers_of(names: Sequence[str], sampling: Sampling) -> list[int]:
    """Return the number in the source of each frame that was taken; with `fps` the frames' names are their numbers."""
    if sampling.fps is not None:
        return [int(name) if name.isdecimal() else i for i, name in enumerate(names)]
    taken = filter(sampling.takes, itertools.count(sampling.start, sampling.step))
    return list(itertools.islice(taken, len(names)))


def shot_samplings(source: Source, sampling: Sampling) -> list[Sampling]:
    """Return what takes each shot of a source, without frames of one colour and flashes; reads the source once."""
    looks, names = [], []
    for frame in source.frames(sampling):
        looks.append(look_at(frame.image))
        names.append(frame.name)
    found, number = warn_of_shots(looks, names, sampling), numbers_of(names, sampling)
    left_out = sorted(number[i] for i in {*found.blank, *found.flashes})
    own = [sampling.skip] if sampling.skip else []
    skip = ",".join([*own, *([_as_ranges(left_out)] if left_out else [])]) or None
    return [
        Sampling(number[shot[0]], sampling.stride, sampling.fps, sum(number[i] not in left_out for i in shot), skip)
        for shot in found.shots
    ]


def _distance(a: Look, b: Look) -> float:
    return float(1 - np.sqrt(a.colours * b.colours).sum())


def _likeness(a: Look, b: Look) -> float:
    """Return the largest correlation of two thumbnails over shifts."""
    return max(_correlation(a.thumbnail, b.thumbnail, y, x) for y in _SHIFTS for x in _SHIFTS)


def _correlation(a: np.ndarray, b: np.ndarray, y: int, x: int) -> float:
    own = a[max(0, y) : _SIDE + min(0, y), max(0, x) : _SIDE + min(0, x)]
    other = b[max(0, -y) : _SIDE + min(0, -y), max(0, -x) : _SIDE + min(0, -x)]
    own, other = own - own.mean(), other - other.mean()
    return float((own * other).sum() / np.sqrt((own**2).sum() * (other**2).sum() + 1e-6))


def _as_ranges(numbers: Sequence[int]) -> str:
    """Return numbers in order as text: 0-2,17."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts)
