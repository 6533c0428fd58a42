"""Attention on a CPU: one head and a few hundred queries at a time, with a gradient that computes the weights again."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from vggtjax.network.kernels.pieces import times_for_cores
from vggtjax.network.precision import upcast

ATTENDED = "attended"  # name of attention's output among what a gradient stores
QUERIES_AT_ONCE = 800  # on two cores
LOGITS_OF_A_CHUNK = 2**26  # maximum on more cores, unless 800 queries have more
LOGITS_OF_ALL_HEADS = 320**2  # maximum of a head (queries times keys) for all heads at once


def attention_in_chunks(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    visible: Bool[Array, "B K"] | None,
) -> Float[Array, "B T N D"]:
    """Return `attention`, one head and a few hundred queries at a time: faster than all at once, in little memory."""
    T, D = q.shape[1], q.shape[-1]
    bias = None if visible is None else jnp.where(visible, 0.0, -jnp.inf)  # [B, K]
    if T * k.shape[1] <= LOGITS_OF_ALL_HEADS:  # short clips: a loop over heads would be slower
        queries, keys, values = (x.swapaxes(1, 2) for x in (q * D**-0.5, k, v))
        return _attended(queries, keys, values, None if bias is None else bias[:, None]).swapaxes(1, 2)
    return _head_by_head(q, k, v, bias)


@jax.custom_vjp
def _head_by_head(q, k, v, bias):
    B, T, N, D = q.shape
    # Products in bfloat16 are twice as fast with the keys laid out as columns, products in float32 slower.
    columns = jnp.moveaxis(k, 1, 3) if k.dtype == jnp.bfloat16 else None  # [B, N, D, K]

    def one_head(out, index):  # a head's output overwrites its queries, which saves a transposed copy
        clip, head = index // N, index % N
        queries, values = (x[clip, :, head] for x in (out, v))
        own_columns = k[clip, :, head].T if columns is None else columns[clip, head]
        own_bias = None if bias is None else bias[clip]
        chunks = _chunks(queries * D**-0.5, len(values))
        outputs = jax.lax.map(lambda chunk: _averaged(chunk, own_columns, values, own_bias), chunks)
        return out.at[clip, :, head].set(outputs.reshape(-1, D)[:T]), None

    return jax.lax.scan(one_head, q, jnp.arange(B * N))[0]


def _head_by_head_forward(q, k, v, bias):
    out = checkpoint_name(_head_by_head(q, k, v, bias), ATTENDED)
    return out, (q, k, v, bias, out)


def _head_by_head_backward(residuals, gradient):
    q, k, v, bias, out = residuals
    B, T, N, D = q.shape

    def by_head(x: Float[Array, "B L N D"]) -> Float[Array, "BN L D"]:
        return x.swapaxes(1, 2).reshape(B * N, -1, D)

    def one_head(head):
        q, k, v, bias, out, gradient = head

        def step(sums, chunk):
            to_queries, *to_others, _ = _backward((chunk[0], k, v, bias, chunk[1]), chunk[2])
            return [total + part for total, part in zip(sums, to_others, strict=True)], to_queries

        chunks = tuple(_chunks(x, len(k)) for x in (q * D**-0.5, out, gradient))
        (to_k, to_v), to_q = jax.lax.scan(step, [jnp.zeros_like(k), jnp.zeros_like(v)], chunks)
        return to_q.reshape(-1, D)[:T] * D**-0.5, to_k, to_v

    biases = None if bias is None else jnp.repeat(bias, N, axis=0)
    heads = jax.lax.map(one_head, (by_head(q), by_head(k), by_head(v), biases, by_head(out), by_head(gradient)))
    to_q, to_k, to_v = (x.reshape(B, N, -1, D).swapaxes(1, 2) for x in heads)
    return to_q, to_k, to_v, None if bias is None else jnp.zeros_like(bias)


_head_by_head.defvjp(_head_by_head_forward, _head_by_head_backward)


def chunk_count(queries: int, keys: int) -> int:
    """Return in how many chunks of equal size the queries of a head are attended on a CPU."""
    at_once = max(QUERIES_AT_ONCE, min(times_for_cores() * QUERIES_AT_ONCE, LOGITS_OF_A_CHUNK // keys))
    return math.ceil(queries / at_once)


def _chunks(x: Float[Array, "T D"], keys: int) -> Float[Array, "c R D"]:
    """Cut the queries of a head, or arrays of equal length, into chunks; zeros pad the last chunk."""
    chunks = chunk_count(len(x), keys)
    return jnp.pad(x, ((0, -len(x) % chunks), (0, 0))).reshape(chunks, -1, x.shape[1])


@jax.custom_vjp
def _attended(
    queries: Float[Array, "... R D"],
    keys: Float[Array, "... K D"],
    values: Float[Array, "... K D"],
    bias: Float[Array, "... K"] | None,
) -> Float[Array, "... R D"]:
    return _averaged(queries, keys.swapaxes(-1, -2), values, bias)


def _averaged(queries: Float[Array, "... R D"], columns: Float[Array, "... D K"], values, bias) -> Array:
    """Return the values of every query, averaged by its attention weights; `columns` are the keys."""
    weights = _weights(queries, columns, bias)
    wide = weights.dtype
    if values.dtype != wide:  # rounded once, and stored: XLA would compute the exponentials again for their sum
        weights = jax.lax.optimization_barrier(weights.astype(values.dtype))
    out = jnp.matmul(weights, values, preferred_element_type=wide)
    return (out / weights.sum(axis=-1, keepdims=True, dtype=wide)).astype(values.dtype)


def _weights(queries, columns, bias):
    """Return the attention weights before division by their sum over the keys."""
    wide = jnp.promote_types(queries.dtype, jnp.float32)
    logits = jnp.matmul(queries, columns, preferred_element_type=wide)
    logits = logits if bias is None else logits + bias[..., None, :]
    return jnp.exp(logits - logits.max(axis=-1, keepdims=True))


def _forward(queries, keys, values, bias):
    out = checkpoint_name(_attended(queries, keys, values, bias), ATTENDED)
    return out, (queries, keys, values, bias, out)


def _backward(residuals, gradient):
    """Compute the weights again, which is faster than storing them."""
    queries, keys, values, bias, out = residuals
    weights = _weights(queries, keys.swapaxes(-1, -2), bias)
    weights = weights / weights.sum(axis=-1, keepdims=True)
    upstream = upcast(gradient)
    inner = jnp.sum(out * upstream, axis=-1, keepdims=True)
    logits = weights * (upstream @ upcast(values).swapaxes(-1, -2) - inner)
    to_queries = (logits @ keys).astype(queries.dtype)
    to_keys = _summed_over_queries(queries, logits).astype(keys.dtype)
    to_values = _summed_over_queries(upstream, weights).astype(values.dtype)
    return to_queries, to_keys, to_values, None if bias is None else jnp.zeros_like(bias)


_attended.defvjp(_forward, _backward)


def _summed_over_queries(rows: Float[Array, "... R D"], weights: Float[Array, "... R K"]) -> Float[Array, "... K D"]:
    """Return weights^T rows, with the small transposes written out: XLA's own product takes twice as long on a CPU."""
    columns = jax.lax.optimization_barrier(rows.swapaxes(-1, -2))
    return jax.lax.optimization_barrier(columns @ weights).swapaxes(-1, -2)
