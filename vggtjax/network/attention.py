"""Scaled dot-product attention, as each platform computes it best."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

QUERIES_AT_ONCE = 800
LOGITS_AT_ONCE = 320**2  # queries times keys of a head up to which all heads go at once on a CPU
LOGITS_ELSEWHERE = 2**28  # logits of all clips and heads up to which they are held at once on other platforms
_TPU_BLOCK = 128  # tokens that the kernel for TPUs takes at once: lengths are multiples of it


def attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    kept: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B T N D"]:
    """Return softmax(q k^T / sqrt(D)) v; keys that are not `kept` leave the softmax, and one at least is.

    A CPU works on one head and a few hundred queries at a time, which is several times faster there than all at once
    and needs little memory. NVIDIA GPUs take cuDNN's flash attention for bfloat16 and TPUs jax's own kernel; float32
    on a GPU is computed at once where it fits, and in chunks where it would not.
    """
    branches = {"cpu": _in_chunks, "tpu": _on_tpu, "default": _at_once_or_in_chunks}
    if q.dtype == jnp.bfloat16 and q.shape[-1] % 8 == 0 and q.shape[-1] <= 128 and cudnn_works():
        branches["cuda"] = functools.partial(_packed, implementation="cudnn")
    return jax.lax.platform_dependent(q, k, v, kept, **branches)


@functools.cache
def cudnn_works() -> bool:
    """Return whether cuDNN's attention runs here; tried once, on the first NVIDIA GPU if there is one."""
    try:
        device = jax.devices("cuda")[0]
    except RuntimeError:
        return False
    with jax.ensure_compile_time_eval(), jax.default_device(device):
        try:
            x = jnp.ones((1, 64, 1, 64), jnp.bfloat16)
            jax.block_until_ready(jax.nn.dot_product_attention(x, x, x, implementation="cudnn"))
        except (RuntimeError, NotImplementedError, ValueError):  # no cuDNN, too old a one, or too old a GPU
            return False
    return True


def _at_once_or_in_chunks(q, k, v, kept):
    fits = q.shape[0] * q.shape[2] * q.shape[1] * k.shape[1] <= LOGITS_ELSEWHERE
    return (_at_once if fits else _in_chunks)(q, k, v, kept)


def _at_once(q, k, v, kept):
    return jax.nn.dot_product_attention(q, k, v, mask=None if kept is None else kept[:, None, None, :])


def _packed(q, k, v, kept, *, implementation):
    """Kept keys and values first, and their number: a fused kernel stops there, where a mask would be a dense bias."""
    if kept is None:
        return jax.nn.dot_product_attention(q, k, v, implementation=implementation)
    order = jnp.argsort(~kept, axis=1, stable=True)[:, :, None, None]
    k, v = (jnp.take_along_axis(x, order, axis=1) for x in (k, v))
    lengths = kept.sum(axis=1, dtype=jnp.int32)
    return jax.nn.dot_product_attention(q, k, v, key_value_seq_lengths=lengths, implementation=implementation)


def _on_tpu(q, k, v, kept):
    """jax's flash attention for TPUs; a key that is dropped, or only fills the last block, is of another segment."""
    from jax.experimental.pallas.ops.tpu.flash_attention import SegmentIds, flash_attention

    T, K = q.shape[1], k.shape[1]

    def padded(x):
        return jnp.pad(x, ((0, 0), (0, -x.shape[1] % _TPU_BLOCK), *((0, 0),) * (x.ndim - 2)))

    queries, keys, values = (padded(x).swapaxes(1, 2) for x in (q, k, v))
    there = padded(jnp.ones((len(k), K), jnp.int32) if kept is None else kept.astype(jnp.int32))
    segments = SegmentIds(jnp.ones((len(q), queries.shape[2]), jnp.int32), there)
    out = flash_attention(queries, keys, values, segment_ids=segments, sm_scale=q.shape[-1] ** -0.5)
    return out.swapaxes(1, 2)[:, :T]


def _in_chunks(q, k, v, kept):
    B, T, N, D = q.shape
    bias = None if kept is None else jnp.where(kept, 0.0, -jnp.inf)  # [B, K]
    if T * k.shape[1] <= LOGITS_AT_ONCE:  # short clips: a loop over heads would cost more than it saves
        queries, keys, values = (x.swapaxes(1, 2) for x in (q * D**-0.5, k, v))
        return _attended(queries, keys, values, None if bias is None else bias[:, None]).swapaxes(1, 2)
    chunks = math.ceil(T / QUERIES_AT_ONCE)
    padding = -T % chunks

    def one_head(out, index):  # what a head attended to takes the place of its queries: nothing is laid out anew
        clip, head = index // N, index % N
        queries, keys, values = (x[clip, :, head] for x in (out, k, v))
        queries = jnp.pad(queries * D**-0.5, ((0, padding), (0, 0))).reshape(chunks, -1, D)
        mine = None if bias is None else bias[clip]
        made = jax.lax.map(lambda some: _attended(some, keys, values, mine), queries).reshape(-1, D)[:T]
        return out.at[clip, :, head].set(made), None

    return jax.lax.scan(one_head, q, jnp.arange(B * N))[0]


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
