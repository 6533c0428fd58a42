"""Relative poses of all pairs of cameras against the truth: angles, recalls, areas under the recall.

Does not import jax.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from vggtjax.cameras import checked_poses
from vggtjax.errors import InputError, check_choice

THRESHOLDS = (3, 5, 15, 30)  # degrees
Pairs = Literal["vggt", "pi3", "da3", "matching"]

_Poses = Float64[np.ndarray, "N 4 4"]


class _Convention(NamedTuple):
    """How a public evaluation takes a pair of cameras, in the world of the first camera, and its area."""

    relative: Callable[[_Poses, _Poses], _Poses]
    is_binned: bool = True


_CONVENTIONS: dict[str, _Convention] = {
    "vggt": _Convention(lambda one, other: one @ np.linalg.inv(other)),
    "pi3": _Convention(lambda one, other: other @ np.linalg.inv(one)),
    "da3": _Convention(lambda one, other: np.linalg.inv(one) @ other),
    "matching": _Convention(lambda one, other: other @ np.linalg.inv(one), is_binned=False),
}


class PairAngles(NamedTuple):
    """Errors of the pairs (0, 1), (0, 2), ... in degrees."""

    rotation: Float64[np.ndarray, " P"]  # 0 to 180
    translation: Float64[np.ndarray, " P"]  # of the direction, up to its sign: 0 to 90


def pair_angles(
    predicted: Float[np.ndarray, "S 3 4"], truth: Float[np.ndarray, "S 3 4"], pairs: Pairs = "vggt"
) -> PairAngles:
    """Return the errors of the relative pose of every two cameras; neither a world nor a scale needs to be common.

    Args:
        predicted: camera from world.
        truth: those of the same frames, in the order of `predicted`.
        pairs: the relative pose of cameras i < j, T from the world of the first camera: T_i T_j^-1 as VGGT has it,
            T_j T_i^-1 as Pi3 and PoseDiffusion ("pi3", "matching"), or T_i^-1 T_j as Depth Anything 3.

    Raises:
        InputError: fewer than 2 poses, different numbers of poses, or an unknown convention.
    """
    check_choice("pairs", pairs, get_args(Pairs))
    both = [checked_poses(poses) for poses in (predicted, truth)]
    if len(both[0]) != len(both[1]) or len(both[1]) < 2:
        raise InputError(
            f"{len(both[0])} predicted poses and {len(both[1])} true ones; expected equal numbers, 2 or more"
        )
    one, other = np.array([*combinations(range(len(both[1])), 2)]).T
    relative = []
    for poses in both:
        whole = np.concatenate([poses, np.tile([0.0, 0, 0, 1], (len(poses), 1, 1))], axis=1)
        whole = whole @ np.linalg.inv(whole[0])
        relative.append(_CONVENTIONS[pairs].relative(whole[one], whole[other]))
    found, true = relative
    turns = Rotation.from_matrix(found[:, :3, :3]).inv() * Rotation.from_matrix(true[:, :3, :3])
    steps, true_steps = found[:, :3, 3], true[:, :3, 3]
    across = np.linalg.norm(np.cross(steps, true_steps), axis=1)
    along = np.abs((steps * true_steps).sum(axis=1))  # cameras at one place have no direction: 90 degrees
    angles = np.where((across == 0) & (along == 0), 90.0, np.degrees(np.arctan2(across, along)))
    return PairAngles(np.degrees(turns.magnitude()), angles)


def recall_area(errors: Float[np.ndarray, " P"], threshold: int, *, is_binned: bool = True) -> float:
    """Return the share of `threshold` degrees that lies under the recall of errors, 0 to 1.

    Binned: the mean of the recalls at 1, 2, ... degrees (the histograms of PoseDiffusion and VGGT). Else the area
    under the line through the recalls at the errors themselves, level from the last one on (SuperGlue).
    """
    errors = np.sort(np.asarray(errors, np.float64))
    if is_binned:
        below = np.searchsorted(errors, np.arange(1, threshold + 1))
        below[-1] = np.searchsorted(errors, threshold, side="right")  # a histogram's last bin has both its edges
        return float(below.mean() / len(errors))
    within = errors[errors < threshold]
    recalls = np.arange(len(within) + 1) / len(errors)
    return float(np.trapezoid([*recalls, recalls[-1]], [0, *within, threshold]) / threshold)


def pair_scores(
    predicted: Float[np.ndarray, "S 3 4"], truth: Float[np.ndarray, "S 3 4"], pairs: Pairs = "vggt"
) -> dict[str, float]:
    """Return AUC of the larger angle, RRA and RTA at 3, 5, 15 and 30 degrees: `auc_3`, ..., `rta_30`, all 0 to 1.

    RRA and RTA are the shares of pairs whose angle is below the threshold. Arguments and errors as for `pair_angles`;
    "matching" takes the exact area in place of bins of a degree.
    """
    angles, is_binned = pair_angles(predicted, truth, pairs), _CONVENTIONS[pairs].is_binned
    larger = np.maximum(*angles)
    scores = {f"auc_{limit}": recall_area(larger, limit, is_binned=is_binned) for limit in THRESHOLDS}
    for name, errors in (("rra", angles.rotation), ("rta", angles.translation)):
        scores |= {f"{name}_{limit}": float((errors < limit).mean()) for limit in THRESHOLDS}
    return scores
