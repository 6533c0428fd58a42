"""Motion saliency and dynamic masks against the truth. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.ndimage import distance_transform_edt
from scipy.stats import rankdata

from vggtjax.errors import InputError, check_choice

Empty = Literal["davis", "vggt4d"]

_EMPTY_J = {"davis": 1.0, "vggt4d": 0.0}  # J of a frame in which neither mask has a pixel
_RECALLED = 0.5  # score above which a frame counts for the recall
_BINS = 4  # of a sequence, for the decay
_BOUNDARY_WIDTH = 0.008  # largest distance of matched boundaries, in diagonals of the frame


class MaskScores(NamedTuple):
    """DAVIS' statistics of J (intersection over union) and F (boundaries) over frames.

    Mean and recall (the share of frames above 0.5) lie in 0 to 1; the decay is the mean of the first of four bins of
    frames minus the mean of the last.
    """

    j_mean: float
    j_recall: float
    j_decay: float
    f_mean: float
    f_recall: float
    f_decay: float


class FrameScores(NamedTuple):
    """J and F of every frame, 0 to 1."""

    j: Float64[np.ndarray, " S"]
    f: Float64[np.ndarray, " S"]


def auc(saliency: Float[np.ndarray, "*S H W"], mask: Bool[np.ndarray, "*S H W"]) -> float:
    """Return the area under the ROC curve: how often, in a random pair, the dynamic pixel has the higher saliency.

    Exact, by ranks; a tie counts one half.

    Raises:
        InputError: different shapes, saliency that is not finite, or a mask that is all dynamic or all static.
    """
    saliency, mask = np.asarray(saliency), np.asarray(mask, bool)
    if saliency.shape != mask.shape:
        raise InputError(f"saliency has shape {saliency.shape} and the mask {mask.shape}; expected the same")
    if not np.isfinite(saliency).all():
        raise InputError("the saliency has values that are not finite")
    dynamic = int(mask.sum())
    static = mask.size - dynamic
    if not dynamic or not static:
        raise InputError(f"the mask has {dynamic} dynamic and {static} static pixels; expected both")
    ranks = rankdata(saliency.ravel())[mask.ravel()]
    return float((ranks.sum() - dynamic * (dynamic + 1) / 2) / dynamic / static)


def jaccard(predicted: Bool[np.ndarray, "*S H W"], truth: Bool[np.ndarray, "*S H W"]) -> float:
    """Return intersection over union (J of DAVIS); 1 where both are empty."""
    predicted, truth = _masks(predicted, truth)
    union = int((predicted | truth).sum())
    return float((predicted & truth).sum() / union) if union else 1.0


def mask_scores(
    predicted: Bool[np.ndarray, "S H W"], truth: Bool[np.ndarray, "S H W"], *, empty: Empty = "davis"
) -> MaskScores:
    """Return mean, recall and decay of J and F of a sequence (Perazzi et al. 2016).

    Args:
        predicted: masks, True where something moves. All frames count; DAVIS itself skips the first and the last frame
            if the method gets the first mask.
        truth: masks of the same frames, at the same size.
        empty: J of a frame with two empty masks: 1 ("davis") or 0 ("vggt4d"). Its F is 1.

    Raises:
        InputError: masks that are not bool [S, H, W] of one shape, no frame or no pixel, an unknown `empty`.
    """
    return mask_statistics(frame_scores(predicted, truth, empty=empty))


def pooled_scores(
    sequences: Sequence[tuple[Bool[np.ndarray, "S H W"], Bool[np.ndarray, "S H W"]]], *, empty: Empty = "davis"
) -> MaskScores:
    """Return the scores over the joined frames of all sequences: long sequences weigh more.

    The decay compares the first quarter of all frames with the last, and depends on the order of the sequences.

    Args:
        sequences: predicted and true masks of each.
        empty: as for `mask_scores`.

    Raises:
        InputError: no sequence, or as `mask_scores`.
    """
    if not len(sequences):
        raise InputError("no sequences to pool; expected at least 1")
    frames = [frame_scores(predicted, truth, empty=empty) for predicted, truth in sequences]
    return mask_statistics(FrameScores(*(np.concatenate(values) for values in zip(*frames, strict=True))))


def frame_scores(
    predicted: Bool[np.ndarray, "S H W"], truth: Bool[np.ndarray, "S H W"], *, empty: Empty = "davis"
) -> FrameScores:
    """Return J and F of every frame; arguments and errors as for `mask_scores`."""
    check_choice("empty", empty, tuple(_EMPTY_J))
    predicted, truth = _masks(predicted, truth)
    if truth.ndim != 3 or not truth.size:
        raise InputError(f"the masks have shape {truth.shape}; expected [S, H, W] with at least one frame and pixel")
    union = (predicted | truth).sum(axis=(1, 2))
    both = (predicted & truth).sum(axis=(1, 2))
    j = np.where(union > 0, both / np.maximum(union, 1), _EMPTY_J[empty])
    return FrameScores(j, np.array([_boundary_f(*pair) for pair in zip(predicted, truth, strict=True)]))


def _boundary_f(predicted: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return the F-measure of the boundaries, each matched within a disk around the pixels of the other.

    A mask that fills the frame has no boundary, like an empty mask.
    """
    radius = np.ceil(_BOUNDARY_WIDTH * np.hypot(*truth.shape))
    predicted, truth = boundary(predicted), boundary(truth)
    if not predicted.any() or not truth.any():
        return float(predicted.any() == truth.any())
    # Disks x^2 + y^2 <= r^2 around the pixels of a boundary cover all pixels at most r away from it.
    precision = float((np.asarray(distance_transform_edt(~truth))[predicted] <= radius).mean())
    recall = float((np.asarray(distance_transform_edt(~predicted))[truth] <= radius).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def boundary(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return the boundary of a mask, one pixel wide, as in DAVIS.

    Its pixels differ from their right, their lower or their lower right neighbour: the true edge, moved up and left by
    half a pixel. The last row has only right neighbours, the last column only lower ones, and the last pixel of all
    has none: the frame's own edge is not a boundary.
    """
    padded = np.pad(mask, ((0, 1), (0, 1)), mode="edge")  # padding never differs
    inner = padded[:-1, :-1]
    return (inner ^ padded[:-1, 1:]) | (inner ^ padded[1:, :-1]) | (inner ^ padded[1:, 1:])


def mask_statistics(frames: FrameScores) -> MaskScores:
    """Return mean, recall and decay of the J and F of frames."""
    return MaskScores(*_statistics(frames.j), *_statistics(frames.f))


def _statistics(values: Float64[np.ndarray, " S"]) -> tuple[float, float, float]:
    """Return mean, recall and decay; neighbouring bins share a frame, as in DAVIS."""
    # Edges are rounded half up, 1.5 to 2; numpy rounds half to even.
    edges = np.floor(np.linspace(1, len(values), _BINS + 1) + 0.5 + 1e-10).astype(int) - 1
    first, last = values[: edges[1] + 1], values[edges[-2] :]
    return float(values.mean()), float((values > _RECALLED).mean()), float(first.mean() - last.mean())


def _masks(predicted, truth) -> tuple[np.ndarray, np.ndarray]:
    predicted, truth = np.asarray(predicted), np.asarray(truth)
    for name, mask in (("predicted", predicted), ("true", truth)):
        if mask.dtype != bool:
            raise InputError(f"the {name} mask has type {mask.dtype}; expected bool")
    if predicted.shape != truth.shape:
        raise InputError(
            f"the predicted mask has shape {predicted.shape} and the true one {truth.shape}; expected one shape"
        )
    return predicted, truth
