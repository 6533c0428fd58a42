"""Scores of a claimed precision of depth: sparsification, likelihood, calibration. Does not import jax.

A precision is an inverse variance up to one factor: sigma^2 = scale / precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import ndtri

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.depth import measured


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
    errors = predicted[valid].astype(np.float64) - truth[valid]
    claimed = precision[valid].astype(np.float64)
    scale = calibrated_scale(errors, claimed)
    if scale == 0:
        raise InputError("all errors are 0; no scale of the precision has a likelihood")
    return UncertaintyScores(
        ause(errors, claimed),
        gaussian_nll(errors, claimed, 1.0),
        gaussian_nll(errors, claimed, scale),
        expected_calibration_error(errors, claimed, 1.0),
        expected_calibration_error(errors, claimed, scale),
        scale,
    )


def sparsification_curve(
    errors: Float[np.ndarray, "*S"], confidence: Float[np.ndarray, "*S"], steps: int = 20
) -> Sparsification:
    """Return the mean |error| of the remaining pixels after shares of the least confident pixels are removed.

    Pixels of one confidence share their mean error, so the curve does not depend on their order.

    Args:
        errors: prediction minus truth; the sign does not matter.
        confidence: larger for smaller expected errors; only its order matters.
        steps: K, at least 2; the shares are k / K, rounded to whole pixels, and at least one pixel remains.

    Raises:
        InputError: different shapes, no pixel, or values that are not finite.
    """
    size, confidence = _pair(errors, confidence, "confidence")
    size = np.abs(size)
    fractions = np.arange(steps) / steps
    removed = np.minimum(np.round(fractions * len(size)).astype(int), len(size) - 1)
    order = np.argsort(confidence, kind="stable")
    _, groups, counts = np.unique(confidence[order], return_index=True, return_counts=True)
    ordered = np.repeat(np.add.reduceat(size[order], groups) / counts, counts)
    return Sparsification(fractions, _remaining(ordered, removed), _remaining(np.sort(size)[::-1], removed))


def ause(errors: Float[np.ndarray, "*S"], confidence: Float[np.ndarray, "*S"]) -> float:
    """Return the area between the sparsification curve and the oracle's, divided by the mean |error|.

    Both curves have 20 steps; the area is the sum of trapezoids over the removed shares 0 to 0.95. 0 is the score of
    the oracle's own order, and of errors that are all 0 (Ilg et al. 2018, with |error|). Raises InputError as
    `sparsification_curve`.
    """
    curve = sparsification_curve(errors, confidence)
    area = float(np.trapezoid(curve.remaining - curve.oracle, curve.fractions))
    return max(area, 0.0) / float(curve.remaining[0]) if curve.remaining[0] > 0 else 0.0


def calibrated_scale(errors: Float[np.ndarray, "*S"], precision: Float[np.ndarray, "*S"]) -> float:
    """Return the c of maximum likelihood for errors with sigma^2 = c / precision: the mean of precision * error^2.

    Raises InputError for different shapes, no pixel, values that are not finite, a precision that is not above 0.
    """
    errors, precision = _claimed(errors, precision)
    return float((precision * errors**2).mean())


def gaussian_nll(errors: Float[np.ndarray, "*S"], precision: Float[np.ndarray, "*S"], scale: float = 1.0) -> float:
    """Return the mean of log(2 pi sigma^2) / 2 + error^2 / (2 sigma^2), sigma^2 = scale / precision, in nats.

    Raises InputError as `calibrated_scale`.
    """
    errors, precision = _claimed(errors, precision)
    variance = scale / precision
    return float((np.log(2 * np.pi * variance) + errors**2 / variance).mean() / 2)


def reliability_curve(
    errors: Float[np.ndarray, "*S"], precision: Float[np.ndarray, "*S"], scale: float = 1.0, bins: int = 10
) -> Reliability:
    """Return for levels p the share of pixels with |error| <= z_p sigma: p for Gaussian errors.

    z_p is the quantile of the standard normal at (1 + p) / 2, and sigma^2 = scale / precision.

    Args:
        errors, precision: prediction minus truth, and its claimed precision.
        scale: of the variance, above 0.
        bins: number of levels, at least 1; they are the middles (k + 1/2) / bins of equal parts of 0 to 1.

    Raises:
        InputError: as `calibrated_scale`.
    """
    errors, precision = _claimed(errors, precision)
    levels = (np.arange(bins) + 0.5) / bins
    deviations = np.sort(np.abs(errors) * np.sqrt(precision / scale))
    within = np.searchsorted(deviations, ndtri((1 + levels) / 2), side="right")
    return Reliability(levels, within / len(deviations))


def expected_calibration_error(
    errors: Float[np.ndarray, "*S"], precision: Float[np.ndarray, "*S"], scale: float = 1.0, bins: int = 10
) -> float:
    """Return the mean of |observed share - p| over the levels of `reliability_curve`; raises the same errors."""
    curve = reliability_curve(errors, precision, scale, bins)
    return float(np.abs(curve.shares - curve.levels).mean())


def _remaining(ordered: Float64[np.ndarray, " N"], removed) -> Float64[np.ndarray, " K"]:
    """Return the mean of the values after the first `removed`."""
    sums = np.cumsum(ordered[::-1])[::-1]
    return sums[removed] / (len(ordered) - removed)


def _claimed(errors, precision) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    errors, precision = _pair(errors, precision, "precision")
    if (wrong := int((precision <= 0).sum())) > 0:
        raise InputError(f"{wrong} of {len(precision)} precisions are not above 0; expected all to be")
    return errors, precision


def _pair(errors, other, name: str) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    errors, other = np.asarray(errors, np.float64), np.asarray(other, np.float64)
    if errors.shape != other.shape:
        raise InputError(f"errors have shape {errors.shape} and the {name} {other.shape}; expected the same")
    if not errors.size:
        raise InputError("no errors to compare; expected at least one pixel with a true depth")
    for what, values in (("errors", errors), (name, other)):
        if (wrong := int((~np.isfinite(values)).sum())) > 0:
            raise InputError(f"{wrong} values of the {what} are not finite; expected all to be")
    return errors.ravel(), other.ravel()
