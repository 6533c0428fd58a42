"""Scaled dot-product attention, and the suppression of dynamic keys (4DVGGT-D, stage 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.config import Suppress

QUERIES_AT_ONCE = 512


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

    queries = jnp.pad(by_head(q * D**-0.5), ((0, 0), (0, padding), (0, 0)))
    bias = None if kept is None else jnp.repeat(jnp.where(kept, 0.0, -jnp.inf), N, axis=0)
    queries = queries.reshape(B * N, chunks, -1, D)
    out = jax.lax.map(lambda inputs: _one_head(*inputs), (queries, by_head(k), by_head(v), bias))
    return out.reshape(B, N, T + padding, D)[:, :, :T].transpose(0, 2, 1, 3)


@jax.custom_vjp
def _one_head(queries, keys, values, bias):
    """Attention of one head: queries [c, R, D], keys and values [K, D], bias [K] or None."""
    return jax.lax.map(lambda rows: _attended(rows, keys, values, bias), queries)


def _attended(rows, keys, values, bias):
    weights = _weights(rows, keys, bias)
    out = jnp.matmul(weights.astype(values.dtype), values, preferred_element_type=jnp.float32)
    return (out / weights.sum(axis=-1, keepdims=True)).astype(values.dtype)


def _weights(rows, keys, bias):
    logits = jnp.matmul(rows, keys.T, preferred_element_type=jnp.float32)
    logits = logits if bias is None else logits + bias[None]
    return jnp.exp(logits - logits.max(axis=-1, keepdims=True))


def _one_head_forward(queries, keys, values, bias):
    out = _one_head(queries, keys, values, bias)
    return out, (queries, keys, values, bias, out)


def _one_head_backward(kept, gradient):
    """Weights are computed again: to keep them costs more than they do."""
    queries, keys, values, bias, out = kept

    def one_chunk(sums, inputs):
        rows, result, upstream = inputs
        weights = _weights(rows, keys, bias)
        weights = (weights / weights.sum(axis=-1, keepdims=True)).astype(values.dtype)
        inner = jnp.sum(result.astype(jnp.float32) * upstream, axis=-1, keepdims=True)
        logits = (weights * (upstream @ values.T - inner)).astype(keys.dtype)
        added = (logits.T @ rows, weights.T @ upstream)
        return jax.tree.map(lambda a, b: a + b.astype(a.dtype), sums, added), logits @ keys

    start = tuple(jnp.zeros(x.shape, jnp.float32) for x in (keys, values))
    (to_keys, to_values), to_queries = jax.lax.scan(one_chunk, start, (queries, out, gradient))
    to_bias = None if bias is None else jnp.zeros_like(bias)
    return to_queries.astype(queries.dtype), to_keys.astype(keys.dtype), to_values.astype(values.dtype), to_bias


_one_head.defvjp(_one_head_forward, _one_head_backward)


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
