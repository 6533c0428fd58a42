"""Depth up to scale against the truth, in float64 on the host. Does not import jax."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from vggtjax.errors import InputError

DELTA = 1.25


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
    predicted, truth = _used(predicted, truth)
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
    predicted, truth = _used(predicted, truth, valid)
    scaled = predicted * (float(np.median(truth / predicted)) if scale is None else scale)
    close = np.maximum(scaled / truth, truth / scaled) < DELTA
    return DepthErrors(float((np.abs(scaled - truth) / truth).mean()), float(close.mean()))


def measured(truth: Float[np.ndarray, "*S H W"]) -> Bool[np.ndarray, "*S H W"]:
    """Return where depth is known: finite and above 0."""
    truth = np.asarray(truth)
    return np.isfinite(truth) & (truth > 0)


def _used(predicted, truth, valid=None) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    predicted, truth = np.asarray(predicted), np.asarray(truth)
    if predicted.shape != truth.shape:
        raise InputError(f"predicted depth has shape {predicted.shape} and the truth {truth.shape}; expected the same")
    used = measured(truth)
    if valid is not None:
        valid = np.asarray(valid)
        if valid.shape != truth.shape or valid.dtype != bool:
            raise InputError(
                f"valid pixels have shape {valid.shape} and type {valid.dtype}; expected {truth.shape} of bool"
            )
        used &= valid
    if not used.any():
        raise InputError("no pixel has a true depth to compare with")
    if (wrong := int((~measured(predicted[used])).sum())) > 0:
        raise InputError(f"{wrong} predicted depths are not finite and above 0; expected all to be")
    return predicted[used].astype(np.float64), truth[used].astype(np.float64)
