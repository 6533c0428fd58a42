"""The place of the frames of another project's result in the pictures of a data set. Does not import jax."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.media.times import in_seconds, name_times
from vggtjax.clips.preprocessing import Fitter
from vggtjax.errors import ClipError, InputError
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import ARRAYS, TRACKS
from vggtjax.storage.trajectories import associate

Place = tuple[tuple[float, float], tuple[float, float]]  # scale and offset: source (x, y) = scale * (x, y) + offset
_SAME: Place = ((1.0, 1.0), (0.0, 0.0))
_MULTIPLE = 16  # MonST3R and CUT3R cut the sides of their frames to multiples of it
_TRACKED_WIDTH, _TRACKED_SIDE = 518, 336  # of SpatialTrackerV2's frames, and the longest side of what it saves


def placed(
    result: Reconstruction,
    format: str,
    sizes: Sequence[tuple[int, int]],
    names: Sequence[str],
    times: Float64[np.ndarray, " N"] | None = None,
    *,
    strict: bool = False,
) -> Reconstruction:
    """Return the frames of a result that pictures of these sizes show, with their place in them and their names.

    Folders of other projects do not record this place; it follows from the project: VGGT4D resizes to a width and cuts
    tall frames; Depth Anything 3 resizes both sides; MonST3R, those that build on it and CUT3R resize the long side
    and cut both sides to multiples of 16 about the middle; SpatialTrackerV2 does as VGGT, and then shrinks. Results
    of vggtjax record the place themselves; pictures of exactly their frames' size are taken for the frames.

    Args:
        result: the loaded result.
        format: of its folder, such as "vggt4d".
        sizes: width and height of each picture.
        names: of the pictures, without endings, to compare with the frames of the result.
        times: of the pictures in seconds, where they are known.
        strict: refuse a result of other frames than all of these.

    Raises:
        InputError: frames of other pictures, or fewer than pictures where nothing tells whose they are.
    """
    pairs = _pairs(result, format, names, times)
    if not pairs or (strict and not len(pairs) == len(names) == len(result.depth)):
        if format == "vggtjax":
            raise InputError(
                f"the result is of frames {', '.join(result.frame_names[:3])}, ... and the sequence has "
                f"{', '.join(names[:3])}, ...; expected a result of the sequence's pictures"
            )
        raise InputError(
            f"the result has {len(result.depth)} frames, the sequence {len(names)}; expected equal numbers, or numbers "
            "of files or times in pred_traj.txt that tell whose they are"
        )
    chosen = [sizes[theirs] for _, theirs in pairs]
    if pairs != [(place, place) for place in range(len(result.depth))]:
        result = _of_frames(result, [own for own, _ in pairs])
    shown = tuple(names[theirs] for _, theirs in pairs)
    made = _our_own(result, chosen) if format == "vggtjax" else _others(result, format, chosen)
    return made if made.frame_names == shown else dataclasses.replace(made, frame_names=shown)


def _others(result: Reconstruction, format: str, sizes: Sequence[tuple[int, int]]) -> Reconstruction:
    W, H = result.depth.shape[2], result.depth.shape[1]
    places = [_SAME if size == (W, H) else _PLACES[format](*size, W, H) for size in sizes]
    for place, (width, height) in zip(places, sizes, strict=True):
        if place is None:
            raise InputError(
                f"frames of {W} x {H} do not come from pictures of {width} x {height} as {format} makes them"
            )
    return _replaced(result, sizes, [place for place in places if place])


def _our_own(result: Reconstruction, sizes: Sequence[tuple[int, int]]) -> Reconstruction:
    S, H, W = result.depth.shape
    wrong = [i for i, (w, h) in enumerate(sizes) if tuple(result.source_size[i]) != (h, w)]
    if wrong and set(sizes) == {(W, H)}:  # the frames themselves, as an export at the model's size holds them
        return _replaced(result, sizes, [_SAME] * S)
    if wrong:
        height, width = result.source_size[wrong[0]]
        raise InputError(
            f"frame {wrong[0]} of the result was {width} x {height}, the sequence's picture is {sizes[wrong[0]]}; "
            "expected a result of the sequence's pictures"
        )
    return result


def _pairs(
    result: Reconstruction, format: str, names: Sequence[str], times: Float64[np.ndarray, " N"] | None
) -> list[tuple[int, int]]:
    """Return places of frames in the result and the sequence: by name, by time, or by number; in the latter's order.

    Frames of other programs have numbers, and so have those that they lost. As many as the sequence has, counted from 0
    or 1 or unlike the numbers at the end of its names, are the sequence's in order. Else they are those at the end of
    its names, or those of its frames, counted from 0.
    """
    own = {name: place for place, name in enumerate(result.frame_names)}
    wanted = name_times(names) if times is None else times
    if format == "vggtjax":
        named = [(own[name], place) for place, name in enumerate(names) if name in own]
        states = "first_time" in result.settings or name_times(result.frame_names) is not None
        return named or (_by_time(wanted, result.file_times) if states else [])
    numbers = {int(name) if name.isdecimal() else place: place for name, place in own.items()}
    every = sorted({*numbers, *result.settings.get("lost", ())})
    ends = [re.search(r"(\d{1,9})$", name) for name in names]
    by_name = {int(end[1]): place for place, end in enumerate(ends) if end}
    counted = every[0] in (0, 1) and every[-1] - every[0] == len(every) - 1
    if len(every) == len(names) and (counted or by_name.keys().isdisjoint(every)):
        places = {number: place for place, number in enumerate(every)}
    elif len(every) != len(names) and result.timestamps is not None and (pairs := _by_time(wanted, result.timestamps)):
        return pairs
    elif every[-1] == len(every) - 1 and len(every) < len(names):  # counted on, whatever frames they are of
        return []
    elif (None not in ends and by_name.keys() >= set(every)) or every[-1] >= len(names):
        places = by_name
    else:
        places = {number: number for number in every}
    return [(numbers[number], place) for number, place in places.items() if number in numbers]


def _by_time(times: Float64[np.ndarray, " N"] | None, own: Float64[np.ndarray, " S"]) -> list[tuple[int, int]]:
    return [] if times is None else [(int(mine), int(theirs)) for theirs, mine in associate(times, in_seconds(own))]


def _of_frames(result: Reconstruction, frames: Sequence[int]) -> Reconstruction:
    """Return some frames of a result, without tracks."""
    taken = {
        name: getattr(result, name)[list(frames)]
        for name, (_, dimensions) in ARRAYS.items()
        if dimensions[0] == "S" and name not in TRACKS and getattr(result, name) is not None
    }
    names = tuple(result.frame_names[frame] for frame in frames)
    return dataclasses.replace(result, **taken, **dict.fromkeys(TRACKS), frame_names=names, passes=None)


def _replaced(result: Reconstruction, sizes: Sequence[tuple[int, int]], places: Sequence[Place]) -> Reconstruction:
    return dataclasses.replace(
        result,
        source_size=np.array([(height, width) for width, height in sizes]),
        source_scale=np.array([place[0] for place in places]),
        source_offset=np.array([place[1] for place in places]),
    )


def _resized_and_cut(width: int, height: int, W: int, H: int) -> Place | None:
    """VGGT's way: the width becomes W, the height follows in whole patches and is cut to at most W."""
    try:
        fit = Fitter("crop", W, 14 if W % 14 == 0 else 1).fit(width, height, "0")
    except ClipError:
        return None
    return (fit.scale, fit.offset) if fit.frame_size == (W, H) else None


def _stretched(width: int, height: int, W: int, H: int) -> Place | None:
    """Both sides to multiples of a patch, nothing cut: the shape changes by less than a patch."""
    scale = (width / W, height / H)
    return (scale, (0.0, 0.0)) if abs(scale[0] / scale[1] - 1) < 14 / min(W, H) else None


def _cut_about_the_middle(width: int, height: int, W: int, H: int) -> Place | None:
    """The long side is resized, then both sides are cut about the middle: to multiples, and squares to 4 : 3."""
    long = max(width, height)
    resized = tuple(round(side * max(W, H) / long) for side in (width, height))
    cut = (resized[0] // 2 - W // 2, resized[1] // 2 - H // 2)
    trimmed = all(0 <= side - cut_side < _MULTIPLE for side, cut_side in zip(resized, (W, H), strict=True))
    if not trimmed and not (width == height and 4 * H == 3 * W):
        return None
    scale = (width / resized[0], height / resized[1])
    return scale, (cut[0] * scale[0], cut[1] * scale[1])


def _cut_and_shrunk(width: int, height: int, W: int, H: int) -> Place | None:
    """VGGT's way to a width of 518, which then shrinks until no side is above 336; sides are cut to whole pixels."""
    try:
        fit = Fitter("crop", _TRACKED_WIDTH, 14).fit(width, height, "0")
    except ClipError:
        return None
    shrink = _TRACKED_SIDE / max(fit.frame_size)
    if any(abs(shrink * side - own) > 1 for side, own in zip(fit.frame_size, (W, H), strict=True)):
        return None
    (x, y), (wide, high) = fit.scale, fit.frame_size
    return (x * wide / W, y * high / H), fit.offset


_PLACES: dict[str, Callable[[int, int, int, int], Place | None]] = {
    "vggt4d": _resized_and_cut,
    "da3": _stretched,
    **dict.fromkeys(("monst3r", "easi3r", "das3r", "pomato", "cut3r"), _cut_about_the_middle),
    "spatialtrackerv2": _cut_and_shrunk,
}
