"""The depths of bundle-adjusted points where frames see them, and how well they are known. Does not import jax."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from vggtjax.pipeline.refinement.adjust import Adjusted
from vggtjax.pipeline.refinement.field import Measured
from vggtjax.pipeline.refinement.tracks import Tracks, at_result_pixels, dense_depth_at
from vggtjax.results.result import Result

_SIGMA = 0.004  # error of a position, over the picture's longer side: lenses and rolling shutters count in it
_LEAST = 0.03  # no log depth is known better
_LARGEST_SLOPE = 1e3  # pixels by log depth
_REACH = 2.0  # ratios further than this from the median log ratio are wrong points


def measured_at_points(adjusted: Adjusted, tracks: Tracks, result: Result, scale: float) -> Measured:
    """Return the depths of the kept observations over the result's.

    `scale` is the factor from the adjusted world to the result's.
    """
    kept = tracks.chosen(adjusted.kept)
    seen_by = adjusted.cameras.camera_from_world[kept.frames]
    z = np.einsum("mj,mj->m", seen_by[:, 2, :3], adjusted.points[kept.points]) + seen_by[:, 2, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(scale * z / dense_depth_at(result, kept))
    variance = _LEAST**2 + 1 / np.maximum(depth_information(adjusted, kept, result.source_size), 1e-9)
    place = at_result_pixels(result, kept) / np.array(result.depth.shape[:0:-1])
    return Measured(kept.frames, place, ratio, 1 / variance).of(np.isfinite(ratio) & (np.abs(ratio) < _REACH))


def depth_information(
    adjusted: Adjusted, kept: Tracks, sizes: Float64[np.ndarray, "S 2"] | np.ndarray
) -> Float64[np.ndarray, " M"]:
    """Return the inverse variance of the log depth of each observation, by the other frames that see its point."""
    poses, K = adjusted.cameras
    centres = -np.einsum("sji,sj->si", poses[:, :, :3], poses[:, :, 3])
    seen = np.zeros((len(poses), len(adjusted.points)), bool)
    seen[kept.frames, kept.points] = True
    information = np.zeros(len(kept.frames))
    for frame, (pose, k) in enumerate(zip(poses, K, strict=True)):
        of = np.flatnonzero(seen[frame, kept.points] & (kept.frames != frame))
        point = adjusted.points[kept.points[of]]
        along = (point - centres[kept.frames[of]]) @ pose[:, :3].T  # by the log depth in its own frame
        there = point @ pose[:, :3].T + pose[:, 3]
        z = np.where(np.abs(there[:, 2]) > 1e-9, there[:, 2], 1e-9)[:, None]
        slope = (along[:, :2] - there[:, :2] / z * along[:, 2:]) / z * k[[0, 1], [0, 1]]
        squared = np.minimum(np.sum(slope**2, axis=1), _LARGEST_SLOPE**2)
        information[of] += squared / (_SIGMA * sizes[frame].max()) ** 2
    return information
