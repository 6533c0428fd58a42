"""Given masks, at the pixels of the clip's frames. Does not import jax."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from PIL import Image, ImageOps

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.captures.lens import Undistortion
from vggtjax.clips.clip import Clip
from vggtjax.clips.media.images import (
    UNREADABLE,
    ImageFiles,
    check_pixels,
    has_transparency,
    known_formats,
    read_image,
    stored_orientation,
    turned,
)
from vggtjax.clips.media.video import VideoFile
from vggtjax.clips.sources import open_source
from vggtjax.clips.truth import at_clip_pixels
from vggtjax.errors import ClipError, InputError, reading
from vggtjax.storage.file_digest import file_digest

logger = logging.getLogger(__name__)

_ALL_MOVES = 0.95  # share of the pixels
_WHITE = 127  # above it, a pixel of a picture in grey or colour moves
_LABELS = ("P", "1")  # modes whose values are numbers of objects, not brightness
_DEEP_LABELS = ("I", "I;16", "I;16B", "I;16L", "I;16N")  # and of 16 or 32 bits, unless white is their brightest
_DEEP_WHITE = 65535
_SAME_SHAPE, _ACROSS = (2, 3, 4), (5, 6, 7, 8)  # orientations of EXIF that leave and that swap width and height
_NEARLY = 16  # values by which black and white may be off; others are those of a picture
_FROM_ONE = (
    "the masks are numbered from 1 on, and frames of a video from 0: mask 000001 is taken for the second picture; if "
    "the masks count from 1, as FFmpeg writes them, rename them"
)
_FEW_GREYS = 0.1  # share of the opaque pixels of a mask that are neither black nor white: its edges


class MaskWarning(UserWarning):
    """Given masks by which almost all moves, or whose numbers may be those of other frames."""


def load_masks(folder: str | Path, clip: Clip) -> Bool[np.ndarray, "S H W"]:
    """Load pictures of what moves, fitted to the clip's frames.

    A pixel moves where a grey or coloured picture is bright and not transparent, where a picture with a palette, as
    DAVIS has them, or of 16 bits, as KITTI has them, holds an object (any value but 0), or where a cut-out is opaque.
    Crop, scale and padding are those of the frames: every pixel takes the value at the place in the source that its
    centre shows, and padding is static. Frames that are turned by EXIF have masks of the shown or the stored pixels,
    and frames that are undistorted have those of the pictures as they were or, by their size, of the undistorted ones.

    Args:
        folder: a picture per frame, matched by name (`frame_3.png` for `frame_3.jpg`). If no picture is named like a
            frame, there must be as many pictures as frames, in the same order.
        clip: what `load_clip` returned.

    Raises ClipError for a folder without pictures, or pictures that match no frames, have another shape than the
    frames, or are too dark to be a mask. Gives a MaskWarning where more than 95 % of the pixels move.
    """
    source = open_source(str(folder))
    if not isinstance(source, ImageFiles):
        raise ClipError(f"{folder} is not a folder of pictures; masks need one picture per frame")
    names = Counter(path.stem for path in source.paths)
    by_name = {path.stem: path for path in source.paths}
    named = [name for name in clip.frame_names if name in by_name]
    if len(named) == len(clip):
        if twice := [name for name in clip.frame_names if names[name] > 1]:
            raise ClipError(f"{folder} has {names[twice[0]]} pictures named {twice[0]}; expected one for each frame")
        paths = [by_name[name] for name in clip.frame_names]
        _warn_of_first_number(by_name, clip)
    elif named or len(source.paths) != len(clip):
        missing = next(name for name in clip.frame_names if name not in by_name)
        raise ClipError(
            f"{folder} has {len(source.paths)} pictures for {len(clip)} frames, and none is named {missing}; "
            "expected a picture for every frame, named like it or, with other names throughout, in the same order"
        )
    else:
        paths = list(source.paths)
    turns = _turns(clip)
    same_shape = [name for path, name in zip(paths, clip.frame_names, strict=True) if turns.get(name, 1) in _SAME_SHAPE]
    if same_shape and all(stored_orientation(path) == 1 for path in paths):
        logger.warning(
            "%s is stored upside down or mirrored (its EXIF orientation); its mask is taken as of the upright frame",
            same_shape[0],
        )
    masks = np.stack([_mask(path, clip, frame, turns) for frame, path in enumerate(paths)])
    advice = "white is what moves; if it is what rests, invert the pictures: magick mogrify -negate, on a copy"
    _warn_of_inverted(masks, clip, f"{folder}: {advice}")
    return masks


def masks_at_clip_pixels(
    masks: Bool[np.ndarray, "S h w"] | str | Path, clip: Clip, loaded: Clip
) -> Bool[np.ndarray, "S H W"]:
    """Return masks at the pixels of the clip's frames.

    The masks are boolean, of the size of the clip's frames, of those of the clip that was `loaded` and refitted, or of
    the source's pictures, or a folder for `load_masks`. Raises InputError for masks of another type or size, and what
    `load_masks` raises.
    """
    if isinstance(masks, str | Path):
        return load_masks(masks, clip)
    fitted = _fitted(np.asarray(masks), clip, loaded)
    _warn_of_inverted(fitted, clip, "masks: True is what moves; if it is what rests, give ~masks")
    return fitted


def _warn_of_first_number(names: Iterable[str], clip: Clip) -> None:
    """Give a MaskWarning where masks of a video are numbered from 1, as FFmpeg does, and its frames from 0."""
    numbers = {int(name) for name in names if name.isdecimal()}
    if 1 in numbers and 0 not in numbers and isinstance(clip.source, VideoFile):
        warnings.warn(_FROM_ONE, MaskWarning, stacklevel=4)


def _warn_of_inverted(masks: Bool[np.ndarray, "S H W"], clip: Clip, advice: str) -> None:
    """Give a MaskWarning where almost all pixels that are not padding move, which leaves no static world."""
    inside = np.zeros(masks.shape, bool)
    for frame, (left, top, right, bottom) in enumerate(clip.valid_box):
        inside[frame, top:bottom, left:right] = True
    share = masks[inside].mean()
    if share > _ALL_MOVES:
        text = (
            f"{share:.1%} of the pixels move by these masks, which leaves no static world to see cameras by; {advice}"
        )
        warnings.warn(text, MaskWarning, stacklevel=3)


def _fitted(masks: np.ndarray, clip: Clip, loaded: Clip) -> Bool[np.ndarray, "S H W"]:
    expected = clip.images.shape[:3]
    sizes = {(int(height), int(width)) for height, width in clip.source_size}
    if masks.dtype == bool and masks.shape == expected:
        return masks
    if masks.dtype == bool and masks.shape == loaded.images.shape[:3]:
        return np.stack([_resampled(mask, clip, i, partial(loaded.from_source, i)) for i, mask in enumerate(masks)])
    fits = masks.dtype == bool and masks.ndim == 3 and len(masks) == len(clip)
    if fits and all(_is_stored(masks.shape[:0:-1], clip, frame) for frame in range(len(clip))):
        return np.stack([_resampled(mask, clip, i, _to_mask(mask, clip, i)) for i, mask in enumerate(masks)])
    if fits and {masks.shape[1:]} == sizes:
        return at_clip_pixels(clip, masks)
    stored = _turns(clip) if fits else {}
    turns = [stored.get(name, 1) for name in clip.frame_names]
    if fits and all(turn in _ACROSS for turn in turns) and {masks.shape[:0:-1]} == sizes:  # of the stored pixels
        return at_clip_pixels(clip, np.stack([turned(*pair) for pair in zip(masks, turns, strict=True)]))
    source = f" or {(len(clip), *sizes.pop())}, as the source's pictures" if len(sizes) == 1 else ""
    raise InputError(f"masks are {masks.dtype} {masks.shape}; expected bool {expected}, as the frames{source}")


def _turns(clip: Clip) -> dict[str, int]:
    """Return the EXIF orientation of frames that are stored in another way than they are shown, by name."""
    if not isinstance(clip.source, ImageFiles):
        return {}
    files = zip(clip.source.frame_names, clip.source.paths, strict=True)
    wanted = set(clip.frame_names)
    found = {name: stored_orientation(path) for name, path in files if name in wanted}
    return {name: orientation for name, orientation in found.items() if orientation != 1}


def _mask(path: Path, clip: Clip, frame: int, turns: dict[str, int]) -> Bool[np.ndarray, "H W"]:
    picture = read_mask(path)
    if _is_stored(picture.shape[::-1], clip, frame):
        return _resampled(picture, clip, frame, _to_mask(picture, clip, frame))
    height, width = clip.source_size[frame]
    turn = turns.get(clip.frame_names[frame], 1)
    is_stored = abs(picture.shape[1] * width - picture.shape[0] * height) <= max(picture.shape)
    if turn in _ACROSS and height != width and is_stored:  # the mask is of the stored pixels
        picture = turned(picture, turn)
    if abs(picture.shape[0] * width - picture.shape[1] * height) > max(picture.shape):  # more than rounding
        raise ClipError(
            f"mask {path.name} is {picture.shape[1]} x {picture.shape[0]} and its frame {width} x {height}; "
            "expected the same shape"
        )
    return _resampled(picture, clip, frame, _to_mask(picture, clip, frame))


def _is_stored(size: tuple[int, int], clip: Clip, frame: int) -> bool:
    """Return whether a mask of (width, height) is of the picture of an undistorted frame as it was, by its shape."""
    undone = _undistortion(clip, frame)
    return undone is not None and undone.is_stored(size)


def _to_mask(mask: np.ndarray, clip: Clip, frame: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that gives a mask's coordinates of places in the source."""
    undone = _undistortion(clip, frame)
    if undone is not None and _is_stored(mask.shape[::-1], clip, frame):
        return lambda places: undone.stored_points(places) / undone.stored * mask.shape[::-1]
    return lambda places: places / clip.source_size[frame, ::-1] * mask.shape[::-1]


def _undistortion(clip: Clip, frame: int) -> Undistortion | None:
    return clip.source.undistortion(clip.frame_names[frame]) if isinstance(clip.source, CaptureFrames) else None


def _resampled(
    mask: Bool[np.ndarray, "h w"], clip: Clip, frame: int, from_source: Callable[[np.ndarray], np.ndarray]
) -> Bool[np.ndarray, "H W"]:
    """Return a mask at the pixels of a frame; `from_source` gives the mask's coordinates of places in the source."""
    H, W = clip.images.shape[1:3]
    columns, rows = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    left, top, right, bottom = clip.valid_box[frame]
    inside = (columns > left) & (columns < right) & (rows > top) & (rows < bottom)
    places = from_source(clip.to_source(frame, np.stack([columns, rows], axis=-1)))
    x, y = (np.clip(places[..., i], 0, mask.shape[1 - i] - 1).astype(int) for i in (0, 1))
    return mask[y, x] & inside


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read a mask: pixels that are bright and opaque, or in a picture with a palette not 0.

    Raises ClipError for an unreadable picture, or one too dark to be a mask.
    """
    if (labels := _deep_labels(path)) is not None:
        return labels != 0
    shown = read_image(path)  # says what is wrong with a file that is no picture
    with Image.open(path, formats=known_formats()) as picture:
        is_see_through = has_transparency(picture)
        if picture.mode in _LABELS and picture.size == shown.size and not is_see_through:
            return np.asarray(picture) > 0
        layers = np.asarray(ImageOps.exif_transpose(picture).convert("RGBA")) if is_see_through else None
    bright = np.asarray(shown).max(axis=-1)
    if layers is not None:
        opaque = layers[..., 3] > _WHITE
        if not opaque.all() and _is_cut_out(layers[opaque][:, :3].max(axis=-1), path):
            return opaque
        bright = np.where(opaque, bright, 0)
    if 0 < bright.max() <= _WHITE:
        raise ClipError(
            f"mask {path.name} is {bright.max()} of 255 at its brightest; expected black and white, or a palette"
        )
    return bright > _WHITE


def _deep_labels(path: Path) -> np.ndarray | None:
    """Return the upright numbers of objects of a picture of 16 or 32 bits; None for others, and for black and white."""
    with suppress(*UNREADABLE), Image.open(path, formats=known_formats()) as picture:
        if picture.mode not in _DEEP_LABELS:
            return None
        check_pixels(picture, path)
        labels = np.asarray(ImageOps.exif_transpose(picture))
        return None if labels.max() == _DEEP_WHITE else labels
    return None


def _is_cut_out(opaque: np.ndarray, path: Path) -> bool:
    """Return whether opaque pixels show a thing rather than black and white, by the brightest channel of each.

    Raises ClipError for such as are all black: a thing, or a mask without one.
    """
    if not opaque.size:
        return False
    greys = (opaque > _NEARLY) & (opaque < 255 - _NEARLY)
    if (opaque <= _NEARLY).all():
        raise ClipError(
            f"mask {path.name} is black where it is opaque and transparent elsewhere; expected white where the world "
            "moves, black or transparent elsewhere"
        )
    return bool(greys.mean() > _FEW_GREYS)


def masks_digest(masks: np.ndarray | str | Path | bool | None) -> str:
    """Return text that changes when the given masks do. Raises ClipError for masks that are not there."""
    if masks is None or isinstance(masks, bool):
        return str(masks)
    if not isinstance(masks, str | Path):
        masks = np.asarray(masks)
        return hashlib.sha256(f"{masks.dtype} {masks.shape}".encode() + masks.tobytes()).hexdigest()
    source = open_source(str(masks))
    if not isinstance(source, ImageFiles):
        raise ClipError(f"{masks} is not a folder of pictures; masks need one picture per frame")
    with reading(masks, ClipError):
        return f"{masks} {file_digest(source.paths)}"
