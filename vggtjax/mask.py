"""Saliency -> dynamic pixels -> dynamic tokens (4DVGGT-D, stage 1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

BINS = 256
CONSTANT = 1e-6  # a clip whose saliency spans less than this has nothing that moves


def upsample(saliency: Float[Array, "B S h w"], size: tuple[int, int]) -> Float[Array, "B S H W"]:
    """Resize bilinearly to pixels, with half-pixel centres."""
    return jax.image.resize(saliency, (*saliency.shape[:2], *size), "bilinear", antialias=False)


def otsu_threshold(values: Float[Array, ...], bins: int = BINS) -> Float[Array, ""]:
    """Return Otsu's threshold: the bin centre that maximises the variance between the two classes it makes.

    The histogram has `bins` bins from the smallest to the largest value, as scikit-image's `threshold_otsu`; of
    equally good centres the lowest is taken. Constant values give that value.
    """
    values = values.ravel()
    low, high = values.min(), values.max()
    width = (high - low) / bins
    index = jnp.floor((values - low) / jnp.where(width > 0, width, 1)).astype(jnp.int32)
    counts = jnp.bincount(jnp.clip(index, 0, bins - 1), length=bins) / values.size
    centres = low + width * (jnp.arange(bins) + 0.5)
    offsets = jnp.arange(bins) + 0.5  # means in units of bins, which keeps every sum of order one
    below, above = jnp.cumsum(counts), jnp.cumsum(counts[::-1])[::-1]
    mean_below = jnp.cumsum(counts * offsets) / jnp.maximum(below, 1e-12)
    mean_above = jnp.cumsum((counts * offsets)[::-1])[::-1] / jnp.maximum(above, 1e-12)
    between = below[:-1] * above[1:] * (mean_below[:-1] - mean_above[1:]) ** 2
    return jnp.where(width > 0, centres[jnp.argmax(between)], low)


def dynamic_pixels(saliency: Float[Array, "B S h w"], size: tuple[int, int]) -> Bool[Array, "B S H W"]:
    """Return the dynamic pixels of every clip: at or above Otsu's threshold over all its pixels.

    A clip of constant saliency (one frame, or nothing moves) has none.
    """

    def one_clip(pixels: Float[Array, "S H W"]) -> Bool[Array, "S H W"]:
        varies = pixels.max() - pixels.min() >= CONSTANT
        return (pixels >= otsu_threshold(pixels)) & varies

    return jax.vmap(one_clip)(upsample(saliency, size))


def dynamic_tokens(mask: Bool[Array, "B S H W"], patch_size: int) -> Bool[Array, "B S h w"]:
    """Return the tokens any pixel of which is dynamic."""
    B, S, H, W = mask.shape
    return mask.reshape(B, S, H // patch_size, patch_size, W // patch_size, patch_size).any(axis=(3, 5))
