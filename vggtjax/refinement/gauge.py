"""Adjusted cameras in the world and scale of a result: its first camera and its dense depth decide."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from vggtjax.refinement.adjust import Adjusted
from vggtjax.refinement.tracks import Tracks, dense_depth_at
from vggtjax.results.result import Result


class Fitted(NamedTuple):
    """Adjusted cameras in the world of a result, and how well its depth fits them."""

    camera_from_world: Float64[np.ndarray, "S 3 4"]
    spread: float  # factor by which adjusted and dense depth differ in the middle, at this scale; at least 1


def fit_to_result(adjusted: Adjusted, tracks: Tracks, result: Result) -> Fitted:
    """Move the adjusted cameras so that the first is the result's, at the scale at which depths agree in the middle."""
    poses = adjusted.cameras.camera_from_world
    kept = adjusted.kept
    turns = poses[tracks.frames[kept]]
    z = np.einsum("mj,mj->m", turns[:, 2, :3], adjusted.points[tracks.points[kept]]) + turns[:, 2, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(z / dense_depth_at(result, tracks)[kept])  # of unscaled adjusted depth by dense depth
    known = np.isfinite(logs)
    scale = np.exp(-np.median(logs[known]))
    spread = float(np.exp(np.median(np.abs(logs[known] + np.log(scale)))))
    first = result.camera_from_world[0].astype(np.float64)
    return Fitted(_from_first(poses, first, scale), spread)


def _from_first(
    poses: Float64[np.ndarray, "S 3 4"], first: Float64[np.ndarray, "3 4"], scale: float
) -> Float64[np.ndarray, "S 3 4"]:
    """Return the poses relative to the first one, their translations scaled, in the world of the camera `first`."""
    turn = poses[:, :, :3] @ poses[0, :, :3].T
    moved = scale * (poses[:, :, 3] - turn @ poses[0, :, 3])
    placed = np.concatenate([turn @ first[:, :3], (turn @ first[:, 3] + moved)[:, :, None]], axis=2)
    placed[0] = first  # to the last bit
    return placed
