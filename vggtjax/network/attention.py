"""Scaled dot-product attention, and the suppression of dynamic keys (4DVGGT-D, stage 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.config import Suppress

QUERIES_AT_ONCE = 800
LOGITS_AT_ONCE = 320**2  # queries times keys of a head up to which all heads go at once on a CPU


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
    """Return softmax(q k^T / sqrt(D)) v; keys that are not `kept` leave the softmax.

    A CPU works on one head and a few hundred queries at a time, which is several times faster there than all at once
    and needs little memory; other platforms take jax's own kernel.
    """
    return jax.lax.platform_dependent(q, k, v, kept, cpu=_in_chunks, default=_at_once)


def _at_once(q, k, v, kept):
    return jax.nn.dot_product_attention(q, k, v, mask=None if kept is None else kept[:, None, None, :])


def _in_chunks(q, k, v, kept):
    B, T, N, D = q.shape
    chunks = math.ceil(T / QUERIES_AT_ONCE)
    padding = -T % chunks

    def by_head(x: Float[Array, "B L N D"]) -> Float[Array, "BN L D"]:
        return x.transpose(0, 2, 1, 3).reshape(B * N, -1, D)

    def one_head(inputs):
        queries, keys, values, bias = inputs
        return jax.lax.map(lambda chunk: _attended(chunk, keys, values, bias), queries)

    queries, keys, values = by_head(q * D**-0.5), by_head(k), by_head(v)
    bias = None if kept is None else jnp.repeat(jnp.where(kept, 0.0, -jnp.inf), N, axis=0)
    if T * k.shape[1] <= LOGITS_AT_ONCE:  # short clips: a loop over heads would cost more than it saves
        out = _attended(queries, keys, values, bias)
    else:
        queries = jnp.pad(queries, ((0, 0), (0, padding), (0, 0))).reshape(B * N, chunks, -1, D)
        out = jax.lax.map(one_head, (queries, keys, values, bias)).reshape(B * N, T + padding, D)[:, :T]
    return out.reshape(B, N, T, D).transpose(0, 2, 1, 3)


@jax.custom_vjp
def _attended(
    queries: Float[Array, "... R D"],
    keys: Float[Array, "... K D"],
    values: Float[Array, "... K D"],
    bias: Float[Array, "... K"] | None,
) -> Float[Array, "... R D"]:
    weights = _weights(queries, keys, bias)
    out = jnp.matmul(weights.astype(values.dtype), values, preferred_element_type=jnp.float32)
    return (out / weights.sum(axis=-1, keepdims=True)).astype(values.dtype)


def _weights(queries, keys, bias):
    """Attention weights up to their sum over the keys."""
    logits = jnp.matmul(queries, keys.swapaxes(-1, -2), preferred_element_type=jnp.float32)
    logits = logits if bias is None else logits + bias[..., None, :]
    return jnp.exp(logits - logits.max(axis=-1, keepdims=True))


def _forward(queries, keys, values, bias):
    out = _attended(queries, keys, values, bias)
    return out, (queries, keys, values, bias, out)


def _backward(residuals, gradient):
    """The weights are computed again: to keep them costs more than they do."""
    queries, keys, values, bias, out = residuals
    weights = _weights(queries, keys, bias)
    weights = weights / weights.sum(axis=-1, keepdims=True)
    upstream = gradient.astype(jnp.float32)
    inner = jnp.sum(out * upstream, axis=-1, keepdims=True)
    logits = weights * (upstream @ values.swapaxes(-1, -2).astype(jnp.float32) - inner)
    to_queries = (logits @ keys).astype(queries.dtype)
    to_keys = (logits.swapaxes(-1, -2) @ queries).astype(keys.dtype)
    to_values = (weights.swapaxes(-1, -2) @ upstream).astype(values.dtype)
    return to_queries, to_keys, to_values, None if bias is None else jnp.zeros_like(bias)


_attended.defvjp(_forward, _backward)


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
