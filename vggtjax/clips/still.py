"""Whether frames show one picture, whatever a codec made of it. For arrays of numpy and of jax; does not import jax."""

from __future__ import annotations

from typing import TypeVar

Pictures = TypeVar("Pictures")  # [..., H, W, 3] in [0, 1]

# Largest difference of the means over boxes of 3, 9 and 27 pixels: of grey, and of a channel, whose noise is larger
# because codecs keep colours at half the resolution. A codec errs much at few pixels and little over many.
_BOUNDS = ((12 / 255, 18 / 255), (5 / 255, 9 / 255), (2.5 / 255, 5 / 255))


def same_picture(a: Pictures, b: Pictures) -> Pictures:
    """Return whether two frames are one picture, up to the noise of a codec; [...] for frames [..., H, W, 3].

    Frames differ if a patch of 3 x 3 pixels changes by more than 12/255 in all channels or 18/255 in one, one of 9 x 9
    by more than 5/255 or 9/255, or one of 27 x 27 by more than 2.5/255 or 5/255; and where values are not finite.
    """
    difference, step = a - b, 1  # type: ignore[operator]
    same = True
    for grey, channel in _BOUNDS:
        if min(difference.shape[-3:-1]) >= 3 * step:  # smaller pictures keep the smaller boxes
            difference = _over_rows_and_columns(difference, step)
        step *= 3
        same = same & (abs(difference.mean(axis=-1)).max(axis=(-2, -1)) <= grey)
        same = same & (abs(difference).max(axis=(-3, -2, -1)) <= channel)
    return same  # type: ignore[return-value]


def _over_rows_and_columns(x, step: int):
    """Return the means of 3 x 3 values that are `step` apart: from means over boxes, those over boxes 3 times wider."""
    x = (x[..., : -2 * step, :, :] + x[..., step:-step, :, :] + x[..., 2 * step :, :, :]) / 3
    return (x[..., : -2 * step, :] + x[..., step:-step, :] + x[..., 2 * step :, :]) / 3
