"""Scores of a claimed precision of depth: sparsification, likelihood, calibration. Does not import jax.

A precision is an inverse variance up to one factor: sigma^2 = scale / precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import ndtri

from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.depth import measured


class Sparsification(NamedTuple):
    """Mean |error| of the remaining pixels after a share of the pixels is removed."""

    fractions: Float64[np.ndarray, " K"]  # removed: 0, 1 / K, ..., 1 - 1 / K
    remaining: Float64[np.ndarray, " K"]  # the least confident first
    oracle: Float64[np.ndarray, " K"]  # the largest errors first


class Reliability(NamedTuple):
    """Shares of errors within the central intervals of a Gaussian."""

    levels: Float64[np.ndarray, " K"]  # claimed, 0 to 1
    shares: Float64[np.ndarray, " K"]  # observed


class UncertaintyScores(NamedTuple):
    """Scores of a claimed precision; lower is better except for `scale`.

    Attributes:
        ause: area between the sparsification curve and the oracle's, over the mean |error|.
        nll: mean negative log likelihood per pixel with the given precision, in nats.
        nll_calibrated: the same with the scale of maximum likelihood.
        ece: expected calibration error with the given precision, 0 to 1.
        ece_calibrated: the same with the scale of maximum likelihood.
        scale: that scale.
    """

    ause: float
    nll: float
    nll_calibrated: float
    ece: float
    ece_calibrated: float
    scale: float


def uncertainty_scores(
    predicted: Float[np.ndarray, "*S"], truth: Float[np.ndarray, "*S"], precision: Float[np.ndarray, "*S"]
) -> UncertaintyScores:
    """Return scores of a precision against the errors of depth, over the pixels with a true depth.

    Args:
        predicted: depth, aligned to the truth by the caller.
        truth: depth; values that are not finite and above 0 are unknown and do not count.
        precision: above 0 at pixels with a true depth.

    Raises:
        InputError: different shapes, no pixel with a true depth, values that are not finite, a precision that is not
            above 0, or errors that are all 0, for which no Gaussian has a likelihood.
    """
    predicted, truth, precision = (np.asarray(values) for values in (predicted, truth, precision))
    if not predicted.shape == truth.shape == precision.shape:
        raise InputError(
            f"prediction, truth and precision have shapes {predicted.shape}, {truth.shape} and {precision.shape}; "
            "expected one shape"
        )
    valid = measured(truth)
    if not valid.any():
        raise InputError("no errors to compare; expected at least one pixel with a true depth")
    errors = predicted[valid].astype(np.float64) - truth[valid]
    claimed = precision[valid].astype(np.float64)
    for what, values in (("errors", errors), ("precision", claimed)):
        if (wrong := int((~np.isfinite(values)).sum())) > 0:
            raise InputError(f"{wrong} values of the {what} are not finite; expected all to be")
    if (wrong := int((claimed <= 0).sum())) > 0:
        raise InputError(f"{wrong} of {len(claimed)} precisions are not above 0; expected all to be")
    scale = float((claimed * errors**2).mean())  # of maximum likelihood for sigma^2 = scale / precision
    if scale == 0:
        raise InputError("all errors are 0; no scale of the precision has a likelihood")
    return UncertaintyScores(
        ause(errors, claimed),
        gaussian_nll(errors, claimed, 1.0),
        gaussian_nll(errors, claimed, scale),
        calibration_error(errors, claimed, 1.0),
        calibration_error(errors, claimed, scale),
        scale,
    )


# What follows takes what `uncertainty_scores` has checked: finite errors [N] in float64, and a precision above 0.


def sparsification_curve(
    errors: Float64[np.ndarray, " N"], confidence: Float64[np.ndarray, " N"], steps: int = 20
) -> Sparsification:
    """Return the mean |error| of the remaining pixels after shares of the least confident pixels are removed.

    Pixels of one confidence share their mean error, so the curve does not depend on their order.

    Args:
        errors: prediction minus truth; the sign does not matter.
        confidence: larger for smaller expected errors; only its order matters.
        steps: K, at least 2; the shares are k / K, rounded to whole pixels, and at least one pixel remains.
    """
    size = np.abs(errors)
    fractions = np.arange(steps) / steps
    removed = np.minimum(np.round(fractions * len(size)).astype(int), len(size) - 1)
    order = np.argsort(confidence, kind="stable")
    _, groups, counts = np.unique(confidence[order], return_index=True, return_counts=True)
    ordered = np.repeat(np.add.reduceat(size[order], groups) / counts, counts)

    def remaining(ordered: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " K"]:
        return np.cumsum(ordered[::-1])[::-1][removed] / (len(ordered) - removed)

    return Sparsification(fractions, remaining(ordered), remaining(np.sort(size)[::-1]))


def ause(errors: Float64[np.ndarray, " N"], confidence: Float64[np.ndarray, " N"]) -> float:
    """Return the area between the sparsification curve and the oracle's, divided by the mean |error|.

    Both curves have 20 steps; the area is the sum of trapezoids over the removed shares 0 to 0.95. 0 is the score of
    the oracle's own order, and of errors that are all 0 (Ilg et al. 2018, with |error|).
    """
    curve = sparsification_curve(errors, confidence)
    area = float(np.trapezoid(curve.remaining - curve.oracle, curve.fractions))
    return max(area, 0.0) / float(curve.remaining[0]) if curve.remaining[0] > 0 else 0.0


def gaussian_nll(errors: Float64[np.ndarray, " N"], precision: Float64[np.ndarray, " N"], scale: float) -> float:
    """Return the mean of log(2 pi sigma^2) / 2 + error^2 / (2 sigma^2), sigma^2 = scale / precision, in nats."""
    variance = scale / precision
    return float((np.log(2 * np.pi * variance) + errors**2 / variance).mean() / 2)


def reliability_curve(
    errors: Float64[np.ndarray, " N"], precision: Float64[np.ndarray, " N"], scale: float = 1.0, bins: int = 10
) -> Reliability:
    """Return for levels p the share of pixels with |error| <= z_p sigma: p for Gaussian errors.

    z_p is the quantile of the standard normal at (1 + p) / 2, and sigma^2 = scale / precision. The levels are the
    middles (k + 1/2) / bins of equal parts of 0 to 1.
    """
    levels = (np.arange(bins) + 0.5) / bins
    deviations = np.sort(np.abs(errors) * np.sqrt(precision / scale))
    within = np.searchsorted(deviations, ndtri((1 + levels) / 2), side="right")
    return Reliability(levels, within / len(deviations))


def calibration_error(
    errors: Float64[np.ndarray, " N"], precision: Float64[np.ndarray, " N"], scale: float = 1.0, bins: int = 10
) -> float:
    """Return the mean of |observed share - p| over the levels of `reliability_curve`."""
    curve = reliability_curve(errors, precision, scale, bins)
    return float(np.abs(curve.shares - curve.levels).mean())
