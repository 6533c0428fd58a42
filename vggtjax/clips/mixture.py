"""Pictures of one folder that are not all frames: depth maps, masks, thumbnails, files that cannot be read.

Does not import jax.
"""

from __future__ import annotations

import fnmatch
import os
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from vggtjax.clips.media.images import UNREADABLE, check_pixels, known_formats
from vggtjax.clips.media.video import is_video_name
from vggtjax.errors import ClipError

# Words in names of pictures that belong to a frame and are none; of frames beside them; of either.
_BESIDE = re.compile(
    "depths?|depthmaps?|disp|disparity|masks?|seg|segm|segmentation|semantics?|instances?|labels?|normals?|flow|conf|"
    "confidence|alpha|matte|ir|infrared|albedo|uncertainty"
)
_FRAMES = re.compile("colou?r|rgb|image|img|frames?|photo|picture|left")
_EITHER = re.compile("dynamic|enlarged|pred|predicted|gt|aligned|raw|vis")

_COVER = re.compile("thumbs?|thumbnails?|preview|cover|poster|contact")  # of a clip

# Pictures that cannot be read: raw ones of cameras, of compositing and drawing programs, and new formats.
_UNREAD = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw"),
    *(".3fr", ".iiq", ".x3f", ".raw", ".jxl", ".jxr", ".exr", ".hdr", ".pfm", ".dpx", ".cin", ".psd", ".psb", ".xcf"),
    *(".svg", ".eps", ".pcx", ".ico", ".qoi", ".dds", ".sgi", ".fits", ".insp"),
)
_DEPTH = re.compile("depths?|depthmaps?|disp|disparity|lidar")
_NEAREST = 0.05  # surface of a depth map, as share of the farthest one
_HIGHEST = 65535
_LEAST_ALIKE = 3  # pictures named alike, before others are odd ones
_MOST_ODD = 0.1  # share of all pictures
_SHOWN = 20  # names in a sentence


def check_frames(images: Sequence[Path], place: str) -> None:
    """Raise ClipError where pictures come in two or more for each frame, with the pattern of those that are frames."""
    by_key: dict[tuple, list[Path]] = defaultdict(list)
    for path in images:
        by_key[path.parent, _key(path)].append(path)
    groups = [group for group in by_key.values() if len(group) > 1]
    beside = [path for group in groups for path in group if _is_beside(path)]
    if beside and len(beside) < sum(map(len, groups)):
        frames = [path for path in images if not _is_beside(path)]
        raise ClipError(
            f"{place} {len(beside)} pictures that are no frames, such as {beside[0].name} beside {frames[0].name}; "
            f"{_advice(frames, images)}"
        )
    stems = Counter((path.parent, path.stem) for path in images)
    twice = [path for path in images if stems[path.parent, path.stem] > 1]
    if twice:
        same = [path for path in twice if path.stem == twice[0].stem and path.parent == twice[0].parent]
        names = " and ".join(path.name for path in same)
        frames = [path for path in images if path.suffix == twice[0].suffix]
        raise ClipError(f"{place} {len(same)} pictures named {same[0].stem} ({names}); {_advice(frames, images)}")


def check_colours(images: Sequence[Path]) -> None:
    """Raise ClipError where several pictures are likely depth maps; the first and the last are looked at.

    These have one channel of 16 bits, or floats, and are named as depth, or lack the dark values of a grey film: there
    is a gap between unknown pixels (0, or the highest value) and the nearest surface. One picture is taken as it is.
    """
    ends = [images[0], images[-1]] if len(images) > 1 else []
    if ends and all(map(_is_depth, ends)):
        raise ClipError(
            f"{images[0].parent}: these are 16-bit single-channel pictures, likely depth maps ({images[0].name}); give "
            "the folder of colour pictures, or write grey frames with 8 bits a value"
        )


def _is_depth(path: Path) -> bool:
    try:
        with Image.open(path, formats=known_formats()) as picture:
            if not (picture.mode in ("I", "F") or picture.mode.startswith("I;16")):
                return False
            if any(map(_DEPTH.fullmatch, (*_words(path), *_words(path.parent)))):
                return True
            check_pixels(picture, path)
            values = np.asarray(picture)
    except (ClipError, *UNREADABLE):
        return False  # its reader says what is wrong
    known = values[(values > 0) & (values < _HIGHEST)] if picture.mode != "F" else values[:0]
    return known.size > 0 and bool(known.min() >= _NEAREST * known.max())


def odd_ones(entries: Sequence[Path], images: Sequence[Path]) -> tuple[str, ...]:
    """Return sentences on files that are left out of a clip of `images`, and on `images` that may be no frames."""
    notes = []
    lost = [path for path in entries if path.suffix.lower() in _UNREAD or (is_video_name(path) and path not in images)]
    if lost:
        kinds = ", ".join(sorted({path.suffix.lower() for path in lost}))
        notes.append(f"left out, as {kinds} is not read as a frame: {_names(lost)}")
    alike = Counter(_template(path) for path in images)
    template, count = alike.most_common(1)[0]
    odd = [path for path in images if _template(path) != template]
    beside = [path for path in images if _is_beside(path) or any(map(_COVER.fullmatch, _words(path)))]
    if len(beside) == len(images):
        beside = []
    if count >= _LEAST_ALIKE and 0 < len(odd) <= max(1, _MOST_ODD * len(images)):
        beside = odd
    if beside:
        unlike = set(beside)
        frames = [path for path in images if path not in unlike]
        notes.append(
            f"taken as a frame, but named unlike the others: {_names(beside)}; if it is none, {_advice(frames, images)}"
        )
    return tuple(notes)


def _words(path: Path) -> list[str]:
    """Return the words and numbers of a name: frame-000000.color.png has frame, 000000 and color."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", path.stem)
    return re.findall(r"[a-z]+|\d+", parted.lower())


def _is_beside(path: Path) -> bool:
    return any(_BESIDE.fullmatch(word) for word in _words(path))


def _key(path: Path) -> tuple[str, ...]:
    """Return what a frame's name shares with those of the depth maps and masks that belong to it."""
    kinds = (_BESIDE, _FRAMES, _EITHER)
    return tuple(word for word in _words(path) if not any(kind.fullmatch(word) for kind in kinds))


def _template(path: Path) -> str:
    return re.sub(r"\d+", "0", path.stem)


def _names(paths: Sequence[Path]) -> str:
    more = f" and {len(paths) - _SHOWN} more" if len(paths) > _SHOWN else ""
    return ", ".join(path.name for path in paths[:_SHOWN]) + more


def _advice(frames: Sequence[Path], images: Sequence[Path]) -> str:
    """Return what to do: the pattern that only the frames match, where there is one."""
    names, folders = [path.name for path in frames], {path.parent for path in frames}
    start, end = map(os.path.commonprefix, (names, [name[::-1] for name in names]))
    start = start.rstrip("0123456789.")
    end = end[: max(0, min(map(len, names)) - len(start))][::-1].lstrip("0123456789")
    pattern = f"{start}*{end}" if len(names) > 1 else f"*{frames[0].suffix}"
    others = [path.name for path in set(images).difference(frames)]
    if len(folders) == 1 and names and not any(fnmatch.fnmatchcase(name, pattern) for name in others):
        return f"give the pattern '{folders.pop() / pattern}'"
    return "put the frames into a folder of their own"
