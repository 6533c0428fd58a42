"""Region-aware depth from the two passes (4DVGGT-D, stage 3)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

EPSILON = 1e-6


def replace_depth(
    depth1: Float[Array, "*F H W"],
    confidence1: Float[Array, "*F H W"],
    depth2: Float[Array, "*F H W"],
    confidence2: Float[Array, "*F H W"],
    dynamic_mask: Bool[Array, "*F H W"] | Float[Array, "*F H W"],
) -> tuple[Float[Array, "*F H W"], Float[Array, "*F H W"]]:
    """Hard replacement (D_3a): depth and confidence of pass 1 on dynamic pixels, of pass 2 on static ones.

    Shares in place of booleans blend the passes.
    """
    if dynamic_mask.dtype != bool:
        pairs = ((depth1, depth2), (confidence1, confidence2))
        depth, confidence = (dynamic_mask * a + (1 - dynamic_mask) * b for a, b in pairs)
        return depth, confidence
    return jnp.where(dynamic_mask, depth1, depth2), jnp.where(dynamic_mask, confidence1, confidence2)


def fuse_depth(
    depth1: Float[Array, "*F H W"],
    confidence1: Float[Array, "*F H W"],
    depth2: Float[Array, "*F H W"],
    confidence2: Float[Array, "*F H W"],
    dynamic_mask: Bool[Array, "*F H W"],
    eps: float = EPSILON,
) -> tuple[Float[Array, "*F H W"], Float[Array, "*F H W"]]:
    """Confidence fusion (D_3b): inverse-variance weighting with confidence as precision, pixel by pixel.

    On static pixels w = C2 / (C1 + C2 + eps), depth = (1 - w) D1 + w D2, and the fused precision is C1 + C2; on
    dynamic pixels the output is that of pass 1.

    Args:
        depth1: of the plain pass; any number of leading axes.
        confidence1: of that depth.
        depth2: of the mask-aware pass.
        confidence2: of that depth.
        dynamic_mask: True where the scene moves.
        eps: keeps the weight finite where both confidences are 0.

    Returns depth and confidence, of the inputs' shape.
    """
    c1, c2 = (jnp.asarray(confidence) for confidence in (confidence1, confidence2))
    c1, c2 = (jnp.minimum(c, jnp.finfo(c.dtype).max / 4) for c in (c1, c2))  # untrained weights can overflow
    total = c1 + c2 + eps
    fused = (c1 + eps) / total * depth1 + c2 / total * depth2  # (c1 + eps) / total is 1 - w without cancellation
    return jnp.where(dynamic_mask, depth1, fused), jnp.where(dynamic_mask, c1, c1 + c2)


def scale_between(
    depth1: Float[Array, "B S H W"],
    depth2: Float[Array, "B S H W"],
    dynamic_mask: Bool[Array, "B S H W"] | Float[Array, "B S H W"],
) -> Float[Array, " B"]:
    """Return the factor from depth2 to depth1 of each clip: the median ratio over static pixels, 1 without any.

    A pixel is static where its share is below 1/2, if the mask has shares.
    """
    ratio = jnp.where(dynamic_mask.astype(depth1.dtype) >= 0.5, jnp.nan, depth1 / depth2)
    median = clip_median(ratio)
    return jnp.where(jnp.isfinite(median), median, 1.0)


def clip_median(values: Float[Array, "B S ..."]) -> Float[Array, " B"]:
    """Return the median of each clip's values, NaN left out; NaN without any."""
    return jnp.nanmedian(values.reshape(len(values), -1), axis=-1)
