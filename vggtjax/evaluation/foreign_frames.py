"""Where the frames of another project's result lie in the pictures of the data set. Does not import jax."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from vggtjax.clips.preprocessing import Fitter
from vggtjax.errors import ClipError, InputError
from vggtjax.results.reconstruction import Reconstruction

Place = tuple[tuple[float, float], tuple[float, float]]  # scale and offset: source (x, y) = scale * (x, y) + offset
_SAME: Place = ((1.0, 1.0), (0.0, 0.0))
_MULTIPLE = 16  # of sides, to which MonST3R and CUT3R cut their frames


def placed(
    result: Reconstruction, layout: str, sizes: Sequence[tuple[int, int]], names: Sequence[str]
) -> Reconstruction:
    """Return a result that knows how its frames lie in pictures of these sizes.

    Each project has its own way from picture to frame, which its folder does not tell: VGGT4D resizes to a width and
    cuts tall frames; Depth Anything 3 resizes to both sides; MonST3R and CUT3R resize the long side and cut both to
    multiples of 16 about the middle. Our own results know by themselves.

    Args:
        result: as it was loaded.
        layout: whose it is.
        sizes: width and height of each picture.
        names: of the pictures, without endings; our own results remember theirs.

    Raises:
        InputError: another number of pictures than frames, or frames that do not come from such pictures in this way.
    """
    S, H, W = result.depth.shape
    if len(sizes) != S:
        raise InputError(f"the result has {S} frames and the sequence {len(sizes)}; expected a result for every frame")
    if layout == "vggtjax":
        if result.frame_names != tuple(names):
            raise InputError(
                f"the result is of frames {', '.join(result.frame_names[:3])}, ... and the sequence has "
                f"{', '.join(names[:3])}, ...; expected a result of these very pictures"
            )
        if wrong := [i for i, (w, h) in enumerate(sizes) if tuple(result.source_size[i]) != (h, w)]:
            height, width = result.source_size[wrong[0]]
            raise InputError(
                f"frame {wrong[0]} of the result was {width} x {height}, the sequence's picture is {sizes[wrong[0]]}; "
                "expected a result of these very pictures"
            )
        return result
    places = [_SAME if size == (W, H) else _WAYS[layout](*size, W, H) for size in sizes]
    for place, (width, height) in zip(places, sizes, strict=True):
        if place is None:
            raise InputError(
                f"frames of {W} x {H} do not come from pictures of {width} x {height} as {layout} makes them"
            )
    return dataclasses.replace(
        result,
        source_size=np.array([(height, width) for width, height in sizes]),
        source_scale=np.array([place[0] for place in places if place]),
        source_offset=np.array([place[1] for place in places if place]),
    )


def _resized_and_cut(width: int, height: int, W: int, H: int) -> Place | None:
    """VGGT's: the width becomes W, the height what goes with it in whole patches, cut to W if it is more."""
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
    """The long side to that of the frame, then both cut about the middle: by a multiple, or squares to 4 : 3."""
    long = max(width, height)
    resized = tuple(round(side * max(W, H) / long) for side in (width, height))
    cut = (resized[0] // 2 - W // 2, resized[1] // 2 - H // 2)
    small = all(0 <= side - kept < _MULTIPLE for side, kept in zip(resized, (W, H), strict=True))
    if not small and not (width == height and 4 * H == 3 * W):
        return None
    scale = (width / resized[0], height / resized[1])
    return scale, (cut[0] * scale[0], cut[1] * scale[1])


_WAYS: dict[str, Callable[[int, int, int, int], Place | None]] = {
    "vggt4d": _resized_and_cut,
    "da3": _stretched,
    "monst3r": _cut_about_the_middle,
    "cut3r": _cut_about_the_middle,
}
