"""The suppression of dynamic keys (4DVGGT-D, stage 2)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.config import Suppress
from vggtjax.network.attention import attention


@dataclass(frozen=True)
class Suppression:
    """Which keys a block suppresses, how, and whether this layer does so at all.

    Keys may also be shares in [0, 1], of which the layer takes the share `active`: they are shrunk, with gradients.
    """

    keys: Bool[Array, "B T"] | Float[Array, "B T"]
    active: Bool[Array, ""] | Float[Array, ""]
    mode: Suppress


def suppressed_attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B T N D"],
    v: Float[Array, "B T N D"],
    suppression: Suppression | None,
    present: Bool[Array, "B T"] | None = None,
) -> Float[Array, "B T N D"]:
    """Attention that suppresses keys where the layer's flag is set; keys that are not `present` never count.

    `zero` replaces a suppressed key by 0, which keeps its logit, 0, in the softmax (4DVGGT-D); `drop` takes key and
    value out of it (VGGT4D). The flag is a scalar per layer, so the choice is a real branch, not a select. Shares m
    take k (1 - m), which is `zero` for shares of 0 and 1.
    """
    if suppression is None:
        return attention(q, k, v, present)
    if jnp.issubdtype(suppression.keys.dtype, jnp.floating):
        left = 1 - suppression.active * suppression.keys
        return attention(q, k * left.astype(k.dtype)[:, :, None, None], v, present)

    def zero(q, k, v, keys):
        return attention(q, jnp.where(keys[:, :, None, None], 0, k), v, present)

    def drop(q, k, v, keys):
        return attention(q, k, v, ~keys if present is None else ~keys & present)

    def plain(q, k, v, keys):
        return attention(q, k, v, present)

    masked = {"zero": zero, "drop": drop}[suppression.mode]
    return jax.lax.cond(suppression.active, masked, plain, q, k, v, suppression.keys)
