"""Frames that several windows share -> one depth, mask and camera each. Does not import jax.

Depth is blended pixel by pixel by precision: confidence, as in the fusion of the two passes, times the weight of the
window, which falls towards the window's ends. A pixel moves where the windows that say so have half of the weight or
more. Centres of cameras are blended along the line between them, rotations along the shortest turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial.transform import Rotation

from vggtjax.cameras import Similarity, align, checked_centres
from vggtjax.results.result import Result
from vggtjax.results.visible import inside_box, show_points


class WindowView(NamedTuple):
    """What a window says of a frame."""

    result: Result
    number: int  # of the frame in the window
    similarity: Similarity  # the window's world -> the whole clip's
    weight: float  # those of a frame's views sum to 1


class BlendedFrame(NamedTuple):
    """A frame of the whole clip, in fields of Result."""

    depth: Float32[np.ndarray, "H W"]
    depth_confidence: Float32[np.ndarray, "H W"]
    saliency: Float32[np.ndarray, "h w"] | None
    motion: Float32[np.ndarray, "h w"] | None
    dynamic_mask: Bool[np.ndarray, "H W"]
    camera_from_world: Float64[np.ndarray, "3 4"]
    intrinsics: Float64[np.ndarray, "3 3"]


def blend_frame(views: Sequence[WindowView]) -> BlendedFrame:
    """Return a frame that one or more windows have seen."""
    weights = np.array([view.weight for view in views])
    depths = np.stack([view.similarity.scale * view.result.depth[view.number].astype(np.float64) for view in views])
    confidence = np.stack([view.result.depth_confidence[view.number].astype(np.float64) for view in views])
    inside = np.stack([inside_box(view.result.valid_box[view.number], depths.shape[1:]) for view in views])
    valid = show_points(depths, confidence, inside)  # type: ignore[arg-type]
    shares = weights[:, None, None]
    precision = np.where(valid, np.maximum(confidence, np.finfo(np.float32).tiny) * shares, 0)
    total = precision.sum(axis=0)
    blended = np.where(valid, depths, 0) * precision
    depth = np.divide(blended.sum(axis=0), total, out=np.zeros(total.shape), where=total > 0)
    said = np.stack([view.result.dynamic_mask[view.number] for view in views])

    def of_patches(name: str) -> Float32[np.ndarray, "h w"] | None:
        seen = [view for view in views if getattr(view.result, name) is not None]
        if not seen:
            return None
        maps = np.stack([getattr(view.result, name)[view.number] for view in seen])
        return np.average(maps, axis=0, weights=[view.weight for view in seen]).astype(np.float32)

    return BlendedFrame(
        depth=depth.astype(np.float32),
        depth_confidence=_mean_confidence(confidence, valid, shares).astype(np.float32),
        saliency=of_patches("saliency"),
        motion=of_patches("motion"),
        dynamic_mask=(said * shares).sum(axis=0) >= 0.5,
        camera_from_world=blend_cameras(views),
        intrinsics=np.einsum("v,vij->ij", weights, [view.result.intrinsics[view.number] for view in views]),
    )


def _mean_confidence(
    confidence: Float64[np.ndarray, "V H W"], valid: Bool[np.ndarray, "V H W"], shares: Float64[np.ndarray, "V 1 1"]
) -> Float64[np.ndarray, "H W"]:
    """Return the mean of the views whose pixel is valid; of all where none is."""
    used = valid | ~valid.any(axis=0)
    return (np.where(used, confidence, 0) * shares).sum(axis=0) / (used * shares).sum(axis=0)


def blend_cameras(views: Sequence[WindowView]) -> Float64[np.ndarray, "3 4"]:
    """Return the camera of a frame in the world of the whole clip."""
    poses = np.concatenate([align(view.result.camera_from_world[view.number][None], view.similarity) for view in views])
    weights = np.array([view.weight for view in views])
    centre = weights @ checked_centres(poses)
    rotation = Rotation.from_matrix(poses[:, :, :3]).mean(weights).as_matrix()
    return np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1)
