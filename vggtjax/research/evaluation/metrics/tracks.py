"""Tracks of points in 3-D against the truth: shares within distances, mean distances. Does not import jax."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float

from vggtjax.cameras import umeyama_sim3
from vggtjax.errors import InputError, check_choice

TrackAlign = Literal["median", "sim3"]

_PIXELS = (1, 2, 4, 8, 16)  # of TAPVid-3D, in a picture whose shorter side has 256 pixels
_METRES = (0.1, 0.3, 0.5, 1.0)  # of WorldTrack


class Tapvid3dScores(NamedTuple):
    """Shares, 0 to 1, averaged over distances of 1, 2, 4, 8 and 16 pixels; see `tapvid3d_scores`."""

    apd: float
    aj: float
    oa: float


class WorldTrackErrors(NamedTuple):
    """The share of points within 0.1, 0.3, 0.5 and 1 m, averaged, and their mean distance in metres."""

    apd: float
    epe: float


def tapvid3d_scores(
    predicted: Float[np.ndarray, "S N 3"],
    truth: Float[np.ndarray, "S N 3"],
    predicted_visible: Bool[np.ndarray, "S N"],
    visible: Bool[np.ndarray, "S N"],
    focal: float,
    counted: Bool[np.ndarray, "S N"] | None = None,
) -> Tapvid3dScores:
    """Return TAPVid-3D's scores (Koppula et al. 2024) after one scale, the ratio of median distances to the camera.

    APD is the share of visible points whose prediction is closer than delta pixels at the point's true depth, delta z /
    focal; AJ the Jaccard index of such predictions and of visibility; OA the share of right visibilities.

    Args:
        predicted: points in the camera; read where either visibility is True.
        truth: points in the camera.
        predicted_visible: whether the method takes a point for visible.
        visible: whether it is.
        focal: sqrt(fx fy) of a picture whose shorter side has 256 pixels.
        counted: whose visibility is scored, such as where the prediction is known; all by default. Others must be
            invisible in both.

    Raises:
        InputError: different shapes, predictions that are not finite, or no point that is visible in both.
    """
    both = visible & predicted_visible
    scale = _median_ratio(_checked(predicted, truth, visible | predicted_visible), truth, both)
    off = np.linalg.norm(scale * predicted - truth, axis=2)
    shares, jaccards = [], []
    for pixels in _PIXELS:
        right = (off < pixels * truth[..., 2] / focal) & visible
        shares.append(right.sum() / visible.sum())
        # A visible point that is predicted too far is missed and wrong: below, it counts twice, as in the public code.
        jaccards.append((right & predicted_visible).sum() / (visible.sum() + (predicted_visible & ~right).sum()))
    right_visible = (visible == predicted_visible)[... if counted is None else counted]
    return Tapvid3dScores(float(np.mean(shares)), float(np.mean(jaccards)), float(right_visible.mean()))


def world_track_errors(
    predicted: Float[np.ndarray, "S N 3"],
    truth: Float[np.ndarray, "S N 3"],
    counted: Bool[np.ndarray, "S N"],
    align: TrackAlign = "median",
) -> WorldTrackErrors:
    """Return WorldTrack's errors (Feng et al. 2025, St4RTrack) of points in the world of the first camera.

    Args:
        predicted: points in the first predicted camera, up to scale.
        truth: points in the first true camera, metres.
        counted: which of them are scored; both are finite there.
        align: by the ratio of median distances to the first camera, or by the Sim(3) of the least squared error.

    Raises:
        InputError: different shapes, predictions that are not finite, no point, or with "sim3" points on one line.
    """
    check_choice("align", align, get_args(TrackAlign))
    _checked(predicted, truth, counted)
    found, true = predicted[counted], truth[counted]
    if align == "sim3":
        moved = umeyama_sim3(found, true).apply(found)
    else:
        moved = _median_ratio(predicted, truth, counted) * found
    off = np.linalg.norm(moved - true, axis=1)
    return WorldTrackErrors(float(np.mean([(off <= limit).mean() for limit in _METRES])), float(off.mean()))


def _checked(predicted: np.ndarray, truth: np.ndarray, used: np.ndarray) -> np.ndarray:
    if predicted.shape != truth.shape or truth.shape != (*used.shape, 3):
        raise InputError(f"tracks have shapes {predicted.shape} and {truth.shape}; expected [S, N, 3] twice")
    if not np.isfinite(predicted[used]).all():
        raise InputError(f"{int((~np.isfinite(predicted[used])).any(axis=1).sum())} predicted points are not finite")
    return predicted


def _median_ratio(predicted: np.ndarray, truth: np.ndarray, used: np.ndarray) -> float:
    if not used.any():
        raise InputError("no point is visible in both the tracks and the truth; their scale is unknown")
    medians = [float(np.median(np.linalg.norm(points[used], axis=1))) for points in (truth, predicted)]
    if medians[1] <= 0:
        raise InputError("half of the predicted points are in the camera itself; they cannot be scaled")
    return medians[0] / medians[1]
