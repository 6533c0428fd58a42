"""Depth against the truth: of a clip up to scale, and of a video with one alignment for all frames.

In float64 on the host. Does not import jax.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from vggtjax.errors import InputError, check_choice

Align = Literal["metric", "median", "scale", "least-absolute", "scale-shift"]

DELTA = 1.25
_SCALE_ROUNDS = 10
_SHIFT_ROUNDS = 40
_SHRINK = 0.6  # factor of the floor of the residuals, from round to round
_LEAST = 1e-8  # smallest floor, in the truth's unit


class DepthErrors(NamedTuple):
    """AbsRel, the mean of |d - g| / g, and delta1, the share of pixels with max(d / g, g / d) < 1.25."""

    abs_rel: float
    delta1: float


def median_scale(predicted: Float[np.ndarray, "*S H W"], truth: Float[np.ndarray, "*S H W"]) -> float:
    """Return the factor from a clip's predicted depth to the truth: the median of truth / predicted.

    Args:
        predicted: depth up to scale, above 0.
        truth: depth; values that are not finite and above 0 are unknown and do not count.

    Raises:
        InputError: different shapes, no known depth, or a predicted depth there that is not finite and above 0.
    """
    predicted, truth = _pixels(predicted, truth, expected=measured, what="finite and above 0")
    return float(np.median(truth / predicted))


def depth_errors(
    predicted: Float[np.ndarray, "*S H W"],
    truth: Float[np.ndarray, "*S H W"],
    valid: Bool[np.ndarray, "*S H W"] | None = None,
    *,
    scale: float | None = None,
) -> DepthErrors:
    """Return AbsRel and delta1 of a clip after one scale for all its frames.

    Args:
        predicted, truth: as for `median_scale`.
        valid: pixels to use; all pixels with a known depth if None.
        scale: factor of `predicted`; `median_scale` of the same pixels if None. With the whole
            clip's scale, the error of a part includes its misplacement relative to the rest.

    Raises:
        InputError: as `median_scale`, and valid pixels that are not bool or none of which has a known depth.
    """
    predicted, truth = _pixels(predicted, truth, valid, expected=measured, what="finite and above 0")
    scaled = predicted * (float(np.median(truth / predicted)) if scale is None else scale)
    close = np.maximum(scaled / truth, truth / scaled) < DELTA
    return DepthErrors(float((np.abs(scaled - truth) / truth).mean()), float(close.mean()))


def measured(truth: Float[np.ndarray, "*S H W"]) -> Bool[np.ndarray, "*S H W"]:
    """Return where depth is known: finite and above 0."""
    truth = np.asarray(truth)
    return np.isfinite(truth) & (truth > 0)


class VideoDepthErrors(NamedTuple):
    """Errors over all valid pixels of a sequence, d the aligned prediction and g the truth."""

    abs_rel: float  # mean of |d - g| / g
    rmse: float  # in the truth's unit
    delta1: float  # share of pixels with max(d / g, g / d) < 1.25
    delta2: float  # < 1.25^2
    delta3: float  # < 1.25^3
    pixels: int  # valid pixels: the weight of this sequence in a mean over several


class DepthLine(NamedTuple):
    """An alignment of depth: d -> scale * d + shift."""

    scale: float
    shift: float = 0.0


def video_depth_errors(
    predicted: Float[np.ndarray, "S H W"],
    truth: Float[np.ndarray, "S H W"],
    align: Align = "scale",
    *,
    max_depth: float | None = None,
) -> VideoDepthErrors:
    """Return the errors of a sequence's depth after one alignment over all valid pixels of all frames.

    Args:
        predicted: depth at the truth's size, finite wherever the truth is valid. Aligned depth that is not above 0
            counts in AbsRel and RMSE, and is within no delta.
        truth: depth; valid where it is finite, above 0 and below `max_depth`.
        align: "metric" changes nothing; "median" scales by median g / median d; "scale" as MonST3R and CUT3R do it:
            from mean g / mean d, ten rounds of least squares with weights 1 / (|s d - g| + 1e-8), which are on the way
            to the least absolute error and often stop before it; "least-absolute" by the scale of the least absolute
            error itself; "scale-shift" by s d + t of the least absolute error, as `_least_absolute_line` says.
        max_depth: in the truth's unit; no limit if None.

    Raises:
        InputError: different shapes or shapes other than [S, H, W], no valid pixel, a prediction there that is not
            finite, an unknown alignment, a `max_depth` that is not above 0, or a prediction that cannot be aligned: its
            mean, median or scale is not above 0, or with "scale-shift" it is constant.
    """
    if np.ndim(truth) != 3:
        raise InputError(f"the true depth has shape {np.shape(truth)}; expected a sequence [S, H, W]")
    if max_depth is not None and not max_depth > 0:
        raise InputError(f"max_depth is {max_depth}; expected it above 0")
    predicted, truth = _pixels(predicted, truth, None if max_depth is None else np.less(truth, max_depth))
    scale, shift = _line(predicted, truth, align)
    aligned = scale * predicted + shift
    errors = np.abs(aligned - truth)
    abs_rel, rmse = float((errors / truth).mean()), float(np.sqrt((errors**2).mean()))
    del errors
    low, high = np.minimum(aligned, truth), np.maximum(aligned, truth)
    deltas = (float((high < DELTA**power * low).mean()) for power in (1, 2, 3))  # never where `low` is not above 0
    return VideoDepthErrors(abs_rel, rmse, *deltas, pixels=len(truth))


def depth_alignment(
    predicted: Float[np.ndarray, "*S"], truth: Float[np.ndarray, "*S"], align: Align = "scale"
) -> DepthLine:
    """Return the scale and the shift of `video_depth_errors`; arguments and errors are the same, for any shape."""
    return _line(*_pixels(predicted, truth), align)


def _scale(predicted: Float64[np.ndarray, " N"], truth: Float64[np.ndarray, " N"]) -> DepthLine:
    """Return the scale of MonST3R's evaluation: ten rounds of reweighted least squares, converged or not."""
    scale = _ratio(np.mean, predicted, truth)
    for _ in range(_SCALE_ROUNDS):
        weighted = predicted / (np.abs(scale * predicted - truth) + _LEAST)
        scale = float(weighted @ truth / (weighted @ predicted))
    return DepthLine(scale)


def _least_absolute_scale(predicted: Float64[np.ndarray, " N"], truth: Float64[np.ndarray, " N"]) -> DepthLine:
    """Return the s of the least sum of |s d - g|: the median of g / d with weights |d|, the lower one of two."""
    used = predicted != 0
    if not used.any():
        raise InputError("the predicted depth is 0 in all valid pixels; its scale is undefined")
    ratios, weights = truth[used] / predicted[used], np.abs(predicted[used])
    order = np.argsort(ratios, kind="stable")
    below = weights[order].cumsum()
    scale = float(ratios[order[np.searchsorted(below, below[-1] / 2)]])
    if scale <= 0:
        raise InputError(f"the scale of the least absolute error is {scale:.6g}; expected depth above 0 in most pixels")
    return DepthLine(scale)


def _least_absolute_line(predicted: Float64[np.ndarray, " N"], truth: Float64[np.ndarray, " N"]) -> DepthLine:
    """Return s and t of the least sum of |s d + t - g|, by reweighted least squares.

    The start is the least squares line. Forty rounds follow, each the least squares line with weights
    1 / max(|r|, floor) of the residuals r of the round before; the floor starts at their mean and shrinks by 0.6 from
    round to round, down to 1e-8, so that a pixel on an early line does not fix all later lines. The line with the
    least sum is returned.
    """
    middle = float(predicted.mean())
    centred = predicted - middle  # the normal equations stay well conditioned
    spread = float(np.abs(centred).max())
    if spread <= 1e-9 * abs(middle) or spread == 0:
        raise InputError(f"the predicted depth is {middle:.6g} in all valid pixels; scale and shift are undefined")
    weights = np.ones(len(truth))
    best, least, floor = DepthLine(1.0), np.inf, 0.0
    for round_ in range(_SHIFT_ROUNDS + 1):
        total = weights.sum()
        mean, true_mean = float(weights @ centred / total), float(weights @ truth / total)
        weighted = weights * (centred - mean)
        if (variance := float(weighted @ centred)) <= 0:
            break  # all the weight is on one depth
        scale = float(weighted @ truth / variance)
        line = DepthLine(scale, true_mean - scale * mean)
        residuals = np.abs(line.scale * centred + line.shift - truth)
        if (error := float(residuals.sum())) < least:
            best, least = line, error
        floor = error / len(truth) if round_ == 0 else floor * _SHRINK
        weights = 1 / np.maximum(residuals, max(floor, _LEAST))
    return DepthLine(best.scale, best.shift - best.scale * middle)


_ALIGNMENTS: dict[str, Callable[[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]], DepthLine]] = {
    "metric": lambda predicted, truth: DepthLine(1.0),
    "median": lambda predicted, truth: DepthLine(_ratio(np.median, predicted, truth)),
    "scale": _scale,
    "least-absolute": _least_absolute_scale,
    "scale-shift": _least_absolute_line,
}


def _line(predicted: Float64[np.ndarray, " N"], truth: Float64[np.ndarray, " N"], align: Align) -> DepthLine:
    check_choice("align", align, tuple(_ALIGNMENTS))
    return _ALIGNMENTS[align](predicted, truth)


def _ratio(average: Callable, predicted: Float64[np.ndarray, " N"], truth: Float64[np.ndarray, " N"]) -> float:
    divisor = float(average(predicted))
    if divisor <= 0:
        raise InputError(f"the {average.__name__} of the predicted depth is {divisor:.6g}; expected it above 0")
    return float(average(truth)) / divisor


def _pixels(
    predicted, truth, valid=None, *, expected: Callable = np.isfinite, what: str = "finite"
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """Return the pixels of both that are valid (all by default) and have a true depth."""
    predicted, truth = np.asarray(predicted), np.asarray(truth)
    if predicted.shape != truth.shape:
        raise InputError(
            f"predicted depth has shape {predicted.shape} and the truth {truth.shape}; expected the same: resize the "
            "prediction first"
        )
    used = measured(truth)
    if valid is not None:
        valid = np.asarray(valid)
        if valid.shape != truth.shape or valid.dtype != bool:
            raise InputError(f"valid is {valid.dtype} {valid.shape}; expected bool {truth.shape}")
        used &= valid
    if not used.any():
        raise InputError("no pixel has a true depth to compare with")
    predicted = predicted[used].astype(np.float64)
    if (wrong := int((~expected(predicted)).sum())) > 0:
        raise InputError(f"{wrong} predicted depths are not {what} where the truth is valid; expected all to be")
    return predicted, truth[used].astype(np.float64)
