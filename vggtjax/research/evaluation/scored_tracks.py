"""A result against a sequence's true tracks, by its own tracks or by its depth at theirs. Does not import jax."""

from __future__ import annotations

from typing import get_args

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from vggtjax.cameras import project, world_from_camera
from vggtjax.research.evaluation.metrics.tracks import TrackAlign, tapvid3d_scores, world_track_errors
from vggtjax.research.evaluation.truth_at_pixels import AbsentError, TruthAtPixels
from vggtjax.results.result import Result
from vggtjax.results.tracks import SEEN

_SIDE = 256.0  # pixels of the shorter side in which TAPVid-3D counts
_SAME_POINT = 1.0  # pixels between a point that was followed and the true one that it is


def track_metrics(result: Result, truth: TruthAtPixels, *, dense: bool) -> dict[str, float]:
    """Return TAPVid-3D's and WorldTrack's scores over the true tracks, where these are visible in the result's frames.

    A predicted point lies on the ray of its place, as deep as the pixel there, by the result's own cameras. Points of
    unknown depth are not scored.

    Args:
        result: of the sequence's frames, all with a true camera.
        truth: of the sequence, at the pixels of this result.
        dense: take the true places, and the depth there; else the places of the result's tracks that start at true
            ones, within a pixel.
    """
    sequence, true = truth.sequence, truth.sequence.tracks
    if true is None or sequence.world_from_camera is None or sequence.intrinsics is None or not truth.posed.all():
        raise AbsentError("the sequence has no tracks, no intrinsics, or a frame without a camera")
    cameras = world_from_camera(sequence.world_from_camera[:, :3])[:, :3]
    low, high = result.valid_box[:, None, :2], result.valid_box[:, None, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):  # of points that are not visible
        seen = [project(*frame) for frame in zip(true.points, cameras, truth.intrinsics, strict=True)]
        places = np.stack([np.stack(axes[:2], axis=-1) for axes in seen])
        visible = true.visible & ((places >= low) & (places < high)).all(axis=2)
    points, found, found_visible = true.points, places, visible
    if not dense:
        positions, starts = result.track_positions, result.track_frames
        if positions is None or result.track_visibility is None or starts is None:
            raise AbsentError("the result has no tracks; follow the true ones by reconstruct --tracks FILE")
        own, theirs = _matched(positions, starts, places, visible)
        points, visible = points[:, theirs], visible[:, theirs]
        found = positions[:, own].astype(np.float64)
        found_visible = result.track_visibility[:, own] >= SEEN
    lifted = _lifted(result, found)
    known = np.asarray(np.isfinite(lifted).all(axis=2))
    visible, found_visible = visible & known, found_visible & known
    in_camera = _moved(cameras, points)
    to_first = np.broadcast_to(cameras[0], cameras.shape)
    poses = result.world_from_camera.astype(np.float64)[:, :3]
    worlds = _moved(world_from_camera(poses[:1])[:, :3], _moved(poses, lifted)), _moved(to_first, points)
    height, width = result.source_size[0]
    focal = np.sqrt(np.prod(sequence.intrinsics[0][[0, 1], [0, 1]])) * _SIDE / min(height, width)
    scores = tapvid3d_scores(lifted, in_camera, found_visible, visible, float(focal), known)
    kind = "dense" if dense else "tracks"
    metrics = {f"{kind}_apd": scores.apd} | ({} if dense else {"tracks_aj": scores.aj, "tracks_oa": scores.oa})
    scaled, moved = (world_track_errors(*worlds, visible, align) for align in get_args(TrackAlign))
    for name, errors in (("world", scaled), ("sim3", moved)):
        metrics |= {f"{kind}_{name}_{key}": value for key, value in errors._asdict().items()}
    return metrics


def _matched(
    positions: np.ndarray, starts: np.ndarray, places: np.ndarray, visible: np.ndarray
) -> tuple[list[int], list[int]]:
    """Return which tracks start at a visible true point, and at which, each once."""
    own: dict[int, int] = {}
    for frame in np.unique(starts):
        shown, started = np.flatnonzero(visible[frame]), np.flatnonzero(starts == frame)
        if shown.size:
            distances, nearest = map(np.asarray, KDTree(places[frame, shown]).query(positions[frame, started]))
            close = distances <= _SAME_POINT
            own |= dict(zip(shown[nearest[close]].tolist(), started[close].tolist(), strict=True))
    if not own:
        raise AbsentError("none of the result's tracks starts within a pixel of a true one; follow these")
    return [*own.values()], [*own]


def _lifted(result: Result, places: Float64[np.ndarray, "S N 2"]) -> Float64[np.ndarray, "S N 3"]:
    """Return points in the cameras at places, NaN where the depth is unknown; outside the picture that of its edge."""
    low, high = result.valid_box[:, None, :2], result.valid_box[:, None, 2:] - 1
    x, y = np.moveaxis(np.nan_to_num(np.floor(places)).clip(low, high).astype(int), -1, 0)
    depth = result.depth[np.arange(len(places))[:, None], y, x].astype(np.float64)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    K = result.intrinsics.astype(np.float64)[:, None]
    rays = (places - K[..., :2, 2]) / K[..., [0, 1], [0, 1]]
    return np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2) * depth[..., None]


def _moved(poses: Float64[np.ndarray, "#S 3 4"], points: Float64[np.ndarray, "S N 3"]) -> Float64[np.ndarray, "S N 3"]:
    return points @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]
