"""Scaled dot-product attention, and the suppression of dynamic keys (method, section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.config import Suppress


@dataclass(frozen=True)
class Suppression:
    """Which keys a block suppresses, how, and whether this layer does so at all."""

    keys: Bool[Array, "B T"]
    active: Bool[Array, ""]
    mode: Suppress


def attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    kept: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B T N D"]:
    """Return softmax(q k^T / sqrt(D)) v; keys that are not `kept` leave the softmax."""
    mask = None if kept is None else kept[:, None, None, :]
    return jax.nn.dot_product_attention(q, k, v, mask=mask)


def suppressed_attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B T N D"],
    v: Float[Array, "B T N D"],
    suppression: Suppression | None,
) -> Float[Array, "B T N D"]:
    """Attention that suppresses keys where the layer's flag is set.

    `zero` replaces a suppressed key by 0, which keeps its logit, 0, in the softmax (4DVGGT-D); `drop` takes key and
    value out of it (VGGT4D). The flag is a scalar per layer, so the choice is a real branch, not a select.
    """
    if suppression is None:
        return attention(q, k, v)

    def zero(q, k, v, keys):
        return attention(q, jnp.where(keys[:, :, None, None], 0, k), v)

    def drop(q, k, v, keys):
        return attention(q, k, v, kept=~keys)

    def plain(q, k, v, keys):
        return attention(q, k, v)

    masked = {"zero": zero, "drop": drop}[suppression.mode]
    return jax.lax.cond(suppression.active, masked, plain, q, k, v, suppression.keys)
