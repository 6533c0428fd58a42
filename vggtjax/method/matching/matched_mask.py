"""Dynamic pixels from matches: where patches differ from a static world, cut at edges (not in the papers)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.cameras import Cameras
from vggtjax.method.edges import follow_edges
from vggtjax.method.mask import otsu_threshold, upsample
from vggtjax.method.matching.adjustment import at_patches
from vggtjax.method.matching.matched_motion import FEWEST_FRAMES, motion
from vggtjax.method.matching.matches import Matches
from vggtjax.network.heads.pose import decode_pose

TIMES_MEDIAN = 2.5  # Otsu's threshold alone would find something in static clips


class MotionMask(NamedTuple):
    """Dynamic pixels of clips, and what matches say; None where no matches were asked for, and for a single frame."""

    dynamic_mask: Bool[Array, "B S H W"]
    motion: Float[Array, "B S h w"] | None = None  # how far a patch differs from a static world
    is_matched: Bool[Array, "B S"] | None = None  # whether matches gave the frame's mask; else the Gram saliency did


def mine_matched_mask(
    matches: Matches,
    gram_mask: Bool[Array, "B S H W"],
    saliency: Float[Array, "B S h w"],
    images: Float[Array, "B S H W 3"],
    depth: Float[Array, "B S H W"],
    pose_encoding: Float[Array, "B S 9"],
) -> MotionMask:
    """Return dynamic pixels by matches. No gradient passes: a mask is a decision.

    A clip of fewer than three frames, or whose matches do not come back, has its mask by the Gram saliency.

    Args:
        matches: of the first pass.
        gram_mask: the mask by the Gram saliency.
        saliency: the Gram saliency of every patch, in [0, 1].
        images: RGB in [0, 1].
        depth: of the first pass.
        pose_encoding: of the first pass.
    """
    S, grid = images.shape[1], (saliency.shape[2], saliency.shape[3])
    if S < FEWEST_FRAMES:
        return MotionMask(gram_mask, jnp.ones_like(saliency), jnp.zeros(gram_mask.shape[:2], bool))
    cameras = Cameras(*decode_pose(pose_encoding, grid))  # intrinsics in patches
    inputs = jax.lax.stop_gradient((matches, saliency, at_patches(depth, grid), cameras))
    found = jax.lax.map(lambda clip: motion(clip[0], clip[1].reshape(S, -1), clip[2], clip[3], grid), inputs)
    score = jnp.nan_to_num(found.score).reshape(-1, S, *grid)
    mask = jax.vmap(is_moving)(motion_pixels(score, images))
    mask = jnp.where(found.is_matched[:, None, None, None], mask, gram_mask)
    return MotionMask(mask, score, jnp.broadcast_to(found.is_matched[:, None], mask.shape[:2]))


def motion_pixels(motion: Float[Array, "B S h w"], images: Float[Array, "B S H W 3"]) -> Float[Array, "B S H W"]:
    """Return the motion of patches at pixels, ending where colours change. A mask is where it is above a threshold."""
    H, W = images.shape[2:4]
    return follow_edges(upsample(motion, (H, W)), images, H // motion.shape[2])


def is_moving(pixels: Float[Array, "S H W"]) -> Bool[Array, "S H W"]:
    """Return where the motion of a clip's pixels is above Otsu's threshold, and above 2.5 times its median."""
    return pixels >= jnp.maximum(otsu_threshold(pixels), TIMES_MEDIAN * jnp.median(pixels))
