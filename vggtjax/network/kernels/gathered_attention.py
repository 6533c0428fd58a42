"""Attention to the keys and values of all devices, gathered a few heads at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.network.kernels.attention import attention
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.kernels.pieces import largest_divisor

GATHERED_AT_ONCE = 2**27  # numbers of gathered keys, and of values: half a gigabyte of each in float32


def gathered_attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B T N D"],
    v: Float[Array, "B T N D"],
    visible: Bool[Array, "B T"] | None,
    frames: Frames,
) -> Float[Array, "B T N D"]:
    """Return `attention` of the tokens here to the tokens of all devices, in the order of the devices.

    Heads are independent: where all keys do not fit, those of a few heads are gathered, used and dropped, and gathered
    again for the gradient.
    """
    visible = None if visible is None else frames.gather(visible)

    def some_heads(q, k, v):
        return attention(q, frames.gather(k), frames.gather(v), visible)

    N = q.shape[2]
    heads = largest_divisor(N, max(GATHERED_AT_ONCE // (k.size // N * frames.devices), 1))
    if heads == N:
        return some_heads(q, k, v)

    def cut(x: Float[Array, "B T N D"]) -> Float[Array, "G B T n D"]:
        return jnp.moveaxis(x.reshape(*x.shape[:2], -1, heads, x.shape[-1]), 2, 0)

    out = jax.lax.map(lambda part: jax.checkpoint(some_heads)(*part), (cut(q), cut(k), cut(v)))
    return jnp.moveaxis(out, 0, 2).reshape(q.shape)
