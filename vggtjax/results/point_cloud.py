"""Coloured point clouds of a result: what stands still over the whole clip, and what each frame shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from vggtjax.errors import InputError
from vggtjax.results import geometry
from vggtjax.results.reconstruction import Reconstruction


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the world and their sRGB colours."""

    points: Float32[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]

    def __len__(self) -> int:
        return len(self.points)


def inside_pictures(reconstruction: Reconstruction) -> Bool[np.ndarray, "S H W"]:
    """Return the pixels that are not padding."""
    rows, columns = np.arange(reconstruction.depth.shape[1])[:, None], np.arange(reconstruction.depth.shape[2])
    left, top, right, bottom = reconstruction.valid_box.T[:, :, None, None]
    return (left <= columns) & (columns < right) & (top <= rows) & (rows < bottom)


def valid_pixels(reconstruction: Reconstruction) -> Bool[np.ndarray, "S H W"]:
    """Return the pixels that show a point: not padding, with a finite depth above 0 and a finite confidence."""
    depth, inside = reconstruction.depth, inside_pictures(reconstruction)
    return inside & np.isfinite(depth) & (depth > 0) & np.isfinite(reconstruction.depth_confidence)


def check_percentile(confidence_percentile: float) -> None:
    """Raise InputError for a percentile outside [0, 100)."""
    if not 0 <= confidence_percentile < 100:
        raise InputError(f"confidence_percentile is {confidence_percentile}; expected at least 0 and below 100")


def confident_pixels(reconstruction: Reconstruction, confidence_percentile: float) -> Bool[np.ndarray, "S H W"]:
    """Return the valid pixels less the `confidence_percentile` percent with the lowest confidence of the clip.

    The percentile is taken over the valid pixels of all frames together; pixels that equal it stay.
    Raises InputError for a percentile outside [0, 100).
    """
    check_percentile(confidence_percentile)
    valid = valid_pixels(reconstruction)
    if not valid.any():
        return valid
    confidence = reconstruction.depth_confidence
    return valid & (confidence >= np.percentile(confidence[valid], confidence_percentile))


def frame_cloud(reconstruction: Reconstruction, frame: int, pixels: Bool[np.ndarray, "H W"]) -> PointCloud:
    """Return the points of the chosen pixels of one frame, less those too far away for float32."""
    points = geometry.unproject(
        reconstruction.depth[frame : frame + 1],
        reconstruction.intrinsics[frame : frame + 1],
        reconstruction.camera_from_world[frame : frame + 1],
        pixel_offset=0.5,
    )[0][pixels]
    finite = np.isfinite(points).all(axis=-1)
    return PointCloud(points[finite], reconstruction.images[frame][pixels][finite])


def static_cloud(reconstruction: Reconstruction, pixels: Bool[np.ndarray, "S H W"]) -> PointCloud:
    """Return the points of the chosen pixels of all frames that are not dynamic."""
    static = pixels & ~reconstruction.dynamic_mask
    clouds = [frame_cloud(reconstruction, frame, chosen) for frame, chosen in enumerate(static)]
    return PointCloud(
        np.concatenate([cloud.points for cloud in clouds]), np.concatenate([cloud.colors for cloud in clouds])
    )


def dynamic_clouds(reconstruction: Reconstruction, pixels: Bool[np.ndarray, "S H W"]) -> list[PointCloud]:
    """Return, for each frame, the points of the chosen pixels that are dynamic."""
    dynamic = pixels & reconstruction.dynamic_mask
    return [frame_cloud(reconstruction, frame, chosen) for frame, chosen in enumerate(dynamic)]
