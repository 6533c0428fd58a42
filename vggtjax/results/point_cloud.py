"""Coloured point clouds of a result: what stands still over the whole clip, and what each frame shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from vggtjax.results.frame import Frame, valid_pixels
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.saving import Saving


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the world and their sRGB colours."""

    points: Float32[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]

    def __len__(self) -> int:
        return len(self.points)


def check_percentile(confidence_percentile: float) -> None:
    """Raise InputError for a percentile outside [0, 100)."""
    Saving(confidence_percentile)


def least_confidence(reconstruction: Reconstruction, confidence_percentile: float) -> float:
    """Return the confidence that `confidence_percentile` percent of the clip's valid pixels do not reach.

    The percentile is taken over all frames together, at the model's size; 0 where no pixel is valid.
    Raises InputError for a percentile outside [0, 100).
    """
    check_percentile(confidence_percentile)
    confidence = reconstruction.depth_confidence[valid_pixels(reconstruction)]
    return float(np.percentile(confidence, confidence_percentile)) if confidence.size else 0.0


def frame_cloud(frame: Frame, pixels: Bool[np.ndarray, "h w"]) -> PointCloud:
    """Return the points of the chosen pixels of a frame, less those too far away for float32."""
    points = frame.world_points()[pixels]
    finite = np.isfinite(points).all(axis=-1)
    return PointCloud(points[finite], frame.image[pixels][finite])


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """Return the points of all clouds, one after the other."""
    return PointCloud(
        np.concatenate([cloud.points for cloud in clouds]), np.concatenate([cloud.colors for cloud in clouds])
    )
