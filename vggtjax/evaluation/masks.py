"""Motion saliency and dynamic masks against the truth. Does not import jax."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import rankdata

from vggtjax.errors import InputError


class PrecisionRecall(NamedTuple):
    """Share of the predicted pixels that are right, and share of the right pixels that are predicted."""

    precision: float
    recall: float


def auc(saliency: Float[np.ndarray, "*S H W"], mask: Bool[np.ndarray, "*S H W"]) -> float:
    """Return the area under the ROC curve: how often a dynamic pixel has the higher saliency of a random pair.

    Exact, by ranks; a tie counts one half.

    Raises:
        InputError: shapes that differ, saliency that is not finite, or a mask that is all dynamic or all static.
    """
    saliency, mask = np.asarray(saliency), _mask("mask", mask)
    if saliency.shape != mask.shape:
        raise InputError(f"saliency has shape {saliency.shape} and the mask {mask.shape}; expected the same")
    if not np.isfinite(saliency).all():
        raise InputError("the saliency holds values that are not finite")
    dynamic = int(mask.sum())
    static = mask.size - dynamic
    if not dynamic or not static:
        raise InputError(f"the mask has {dynamic} dynamic and {static} static pixels; expected some of both")
    ranks = rankdata(saliency.ravel())[mask.ravel()]
    return float((ranks.sum() - dynamic * (dynamic + 1) / 2) / dynamic / static)


def jaccard(predicted: Bool[np.ndarray, "*S H W"], truth: Bool[np.ndarray, "*S H W"]) -> float:
    """Return intersection over union (J of DAVIS); 1 where both are empty."""
    predicted, truth = _masks(predicted, truth)
    union = int((predicted | truth).sum())
    return float((predicted & truth).sum() / union) if union else 1.0


def precision_recall(predicted: Bool[np.ndarray, "*S H W"], truth: Bool[np.ndarray, "*S H W"]) -> PrecisionRecall:
    """Return precision and recall; the precision of an empty prediction and the recall of an empty truth are 1."""
    predicted, truth = _masks(predicted, truth)
    right = int((predicted & truth).sum())
    found, sought = int(predicted.sum()), int(truth.sum())
    return PrecisionRecall(right / found if found else 1.0, right / sought if sought else 1.0)


def _masks(predicted, truth):
    predicted, truth = _mask("predicted mask", predicted), _mask("true mask", truth)
    if predicted.shape != truth.shape:
        raise InputError(
            f"the predicted mask has shape {predicted.shape} and the true one {truth.shape}; expected one shape"
        )
    return predicted, truth


def _mask(name: str, values) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype != bool:
        raise InputError(f"the {name} has type {values.dtype}; expected bool")
    return values
