"""Scaled dot-product attention, with the fastest implementation for each platform."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from vggtjax.network.pieces import largest_divisor, times_for_cores
from vggtjax.network.precision import widened

ATTENDED = "attended"  # name of attention's output among what a gradient stores
QUERIES_AT_ONCE = 800  # on a CPU of two cores
LOGITS_OF_A_CHUNK = 2**26  # on a CPU of more cores, at most, unless 800 queries have more
LOGITS_AT_ONCE = 320**2  # on a CPU, at most so many logits of a head (queries times keys) for all heads at once
LOGITS_ELSEWHERE = 2**28  # on other platforms, at most so many logits of all clips and heads in memory
_TPU_BLOCK = 128  # tokens in a block of the kernel for TPUs: lengths are multiples of it


def attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    visible: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B T N D"]:
    """Return softmax(q k^T / sqrt(D)) v; only `visible` keys enter the softmax, at least one of every clip.

    A CPU computes one head and a few hundred queries at a time: several times faster than all at once, in little
    memory. NVIDIA GPUs use cuDNN's flash attention for bfloat16, TPUs jax's own kernel. Float32 on a GPU is computed at
    once where the logits fit in memory, otherwise in chunks.
    """
    branches: dict[str, Any] = {"cpu": _in_chunks, "default": _at_once_or_in_chunks}
    D = q.shape[-1]
    if q.dtype == jnp.bfloat16 and D % 8 == 0 and D <= 128 and cudnn_works():
        branches["cuda"] = functools.partial(_packed, implementation="cudnn")
    if jax.default_backend() == "tpu" and jax.device_count() == 1 and (D <= 128 or D % 128 == 0):
        branches["tpu"] = _on_tpu  # jax cannot divide the kernel's work among several devices
    return jax.lax.platform_dependent(q, k, v, visible, **branches)


@functools.cache
def cudnn_works() -> bool:
    """Return whether cuDNN's attention and its gradient run on the first NVIDIA GPU, if any; tried once."""
    try:
        device = jax.local_devices(backend="cuda")[0]
    except RuntimeError:
        return False
    with jax.ensure_compile_time_eval(), jax.default_device(device):
        try:
            x, visible = jnp.ones((2, 13, 1, 64), jnp.bfloat16), jnp.ones((2, 13), bool)
            gradient = jax.grad(lambda x: _packed(x, x, x, visible, implementation="cudnn").sum())
            jax.block_until_ready(gradient(x))
        except (RuntimeError, NotImplementedError, ValueError):  # no cuDNN, or too old, or too old a GPU
            return False
    return True


def _at_once_or_in_chunks(q, k, v, visible):
    clips = LOGITS_ELSEWHERE // (q.shape[2] * q.shape[1] * k.shape[1])  # at once
    if clips >= q.shape[0]:
        return _at_once(q, k, v, visible)
    if clips == 0:
        return _in_chunks(q, k, v, visible)
    clips = largest_divisor(q.shape[0], clips)
    pieces = jax.tree.map(lambda x: x.reshape(-1, clips, *x.shape[1:]), (q, k, v, visible))
    return jax.lax.map(lambda piece: _at_once(*piece), pieces).reshape(q.shape)


def _at_once(q, k, v, visible):
    return jax.nn.dot_product_attention(q, k, v, mask=None if visible is None else visible[:, None, None, :])


def _packed(q, k, v, visible, *, implementation):
    """Order visible keys and values first: a fused kernel stops after their number; a mask would be a dense bias."""
    if visible is None:
        return jax.nn.dot_product_attention(q, k, v, implementation=implementation)
    order = jnp.argsort(~visible, axis=1, stable=True)[:, :, None, None]
    k, v = (jnp.take_along_axis(x, order, axis=1) for x in (k, v))
    lengths = visible.sum(axis=1, dtype=jnp.int32)
    return jax.nn.dot_product_attention(
        q,
        k,
        v,
        query_seq_lengths=lengths * 0 + q.shape[1],  # computed from `lengths`, so that vmap batches both
        key_value_seq_lengths=lengths,
        implementation=implementation,
    )


def _on_tpu(q, k, v, visible):
    """Run jax's flash attention for TPUs; invisible keys, and the padding of the last block, are another segment."""
    from jax.experimental.pallas.ops.tpu.flash_attention import SegmentIds, flash_attention

    T, K = q.shape[1], k.shape[1]

    def padded(x):
        return jnp.pad(x, ((0, 0), (0, -x.shape[1] % _TPU_BLOCK), *((0, 0),) * (x.ndim - 2)))

    queries, keys, values = (padded(x).swapaxes(1, 2) for x in (q, k, v))
    segment = padded(jnp.ones((len(k), K), jnp.int32) if visible is None else visible.astype(jnp.int32))
    segments = SegmentIds(jnp.ones((len(q), queries.shape[2]), jnp.int32), segment)
    exact = "highest" if q.dtype == jnp.float32 else "default"  # bfloat16 products have only the default precision
    with jax.default_matmul_precision(exact):
        out = flash_attention(queries, keys, values, segment_ids=segments, sm_scale=q.shape[-1] ** -0.5)
    return out.swapaxes(1, 2)[:, :T]


def _in_chunks(q, k, v, visible):
    T, D = q.shape[1], q.shape[-1]
    bias = None if visible is None else jnp.where(visible, 0.0, -jnp.inf)  # [B, K]
    if T * k.shape[1] <= LOGITS_AT_ONCE:  # short clips: a loop over heads would be slower
        queries, keys, values = (x.swapaxes(1, 2) for x in (q * D**-0.5, k, v))
        return _attended(queries, keys, values, None if bias is None else bias[:, None]).swapaxes(1, 2)
    return _head_by_head(q, k, v, bias)


@jax.custom_vjp
def _head_by_head(q, k, v, bias):
    B, T, N, D = q.shape

    def one_head(out, index):  # a head's output overwrites its queries, which saves a transposed copy
        clip, head = index // N, index % N
        queries, keys, values = (x[clip, :, head] for x in (out, k, v))
        own_bias = None if bias is None else bias[clip]
        chunks = _chunks(queries * D**-0.5, len(keys))
        outputs = jax.lax.map(lambda chunk: _attended(chunk, keys, values, own_bias), chunks)
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
    weights = _weights(queries, keys, bias)
    out = jnp.matmul(weights.astype(values.dtype), values, preferred_element_type=weights.dtype)
    return (out / weights.sum(axis=-1, keepdims=True)).astype(values.dtype)


def _weights(queries, keys, bias):
    """Return the attention weights before division by their sum over the keys."""
    wide = jnp.promote_types(queries.dtype, jnp.float32)
    logits = jnp.matmul(queries, keys.swapaxes(-1, -2), preferred_element_type=wide)
    logits = logits if bias is None else logits + bias[..., None, :]
    return jnp.exp(logits - logits.max(axis=-1, keepdims=True))


def _forward(queries, keys, values, bias):
    out = checkpoint_name(_attended(queries, keys, values, bias), ATTENDED)
    return out, (queries, keys, values, bias, out)


def _backward(residuals, gradient):
    """Compute the weights again, which is faster than storing them."""
    queries, keys, values, bias, out = residuals
    weights = _weights(queries, keys, bias)
    weights = weights / weights.sum(axis=-1, keepdims=True)
    upstream = widened(gradient)
    inner = jnp.sum(out * upstream, axis=-1, keepdims=True)
    logits = weights * (upstream @ widened(values).swapaxes(-1, -2) - inner)
    to_queries = (logits @ keys).astype(queries.dtype)
    to_keys = _summed_over_queries(queries, logits).astype(keys.dtype)
    to_values = _summed_over_queries(upstream, weights).astype(values.dtype)
    return to_queries, to_keys, to_values, None if bias is None else jnp.zeros_like(bias)


_attended.defvjp(_forward, _backward)


def _summed_over_queries(rows: Float[Array, "... R D"], weights: Float[Array, "... R K"]) -> Float[Array, "... K D"]:
    """Return weights^T rows, with the small transposes written out: XLA's own product takes twice as long on a CPU."""
    columns = jax.lax.optimization_barrier(rows.swapaxes(-1, -2))
    return jax.lax.optimization_barrier(columns @ weights).swapaxes(-1, -2)
