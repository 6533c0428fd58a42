"""Soft dynamic masks: shares of pixels that follow the parameters of the masks smoothly (not in the papers)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.config import MotionConfig, Threshold, VGGTConfig
from vggtjax.method.fusion.family import soft_mask
from vggtjax.method.mask import CONSTANT, find_threshold, upsample


class SoftMasking(NamedTuple):
    """Differentiable parameters of the masks; `soft_masking` returns the paper's values."""

    offset: Float[Array, ""]  # added to the threshold tau of the saliency
    temperature: Float[Array, ""]  # T of sigmoid((saliency - tau) / T); 0 for the hard mask
    strength: Float[Array, " depth"]  # of the suppression in every pair, in [0, 1]
    exponents: Float[Array, " cues"]  # of the cues in their product


def soft_masking(
    config: VGGTConfig, *, temperature: float = 0.0, mask_pairs: int | None = None, motion: MotionConfig | None = None
) -> SoftMasking:
    """Return the paper's values: no offset to the threshold, suppression in the first pairs, the plain product of cues.

    `motion` is the table of cues, the configuration's own if None. `mask_pairs` is the number of pairs, the table's if
    None.
    """
    motion = motion or config.motion
    return SoftMasking(
        jnp.zeros(()),
        jnp.asarray(temperature, float),
        (jnp.arange(config.depth) < motion.masked_pairs(mask_pairs)).astype(float),
        jnp.ones(len(motion.cues)),
    )


def soft_pixels(
    saliency: Float[Array, "B S h w"], masking: SoftMasking, *, size: tuple[int, int], threshold: Threshold = "otsu"
) -> Float[Array, "B S H W"]:
    """Return the dynamic share of every pixel; 0 in a clip of constant saliency. `threshold` is the model's."""

    def one_clip(pixels: Float[Array, "S H W"]) -> Float[Array, "S H W"]:
        varies = pixels.max() - pixels.min() >= CONSTANT
        margin = pixels - find_threshold(pixels, threshold) - masking.offset
        is_dynamic = margin >= 0 if threshold == "otsu" else margin > 0  # as `dynamic_pixels`
        return jnp.where(varies, soft_mask(margin, masking.temperature, is_dynamic.astype(margin.dtype)), 0)

    return jax.vmap(one_clip)(upsample(saliency, size))
