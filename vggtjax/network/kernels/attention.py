"""Scaled dot-product attention, with the fastest implementation for each platform."""

from __future__ import annotations

import functools
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.network.kernels.cpu_attention import attention_in_chunks

LOGITS_AT_ONCE = 2**28  # most in memory, except on a CPU: a gigabyte in float32
_TPU_BLOCK = 128  # tokens in a block of the kernel for TPUs: lengths are multiples of it


def attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    visible: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B T N D"]:
    """Return softmax(q k^T / sqrt(D)) v; only `visible` keys enter the softmax, at least one of every clip.

    A CPU computes one head and a few hundred queries at a time: several times faster than all at once, in little
    memory. NVIDIA GPUs use cuDNN's flash attention for bfloat16, TPUs jax's own kernel. Elsewhere, and for float32 on
    GPUs, attention is computed at once where the logits fit in memory, otherwise in chunks.
    """
    branches: dict[str, Any] = {"cpu": attention_in_chunks, "default": _at_once_or_in_chunks}
    D = q.shape[-1]
    # The platform that the program is compiled for chooses, whether or not one is plugged in.
    if q.dtype == jnp.bfloat16 and D % 8 == 0 and D <= 128 and cudnn_works():
        branches["cuda"] = _with_cudnn
    if (D <= 128 or D % 128 == 0) and _is_on_one_tpu() and find_spec("libtpu"):
        branches["tpu"] = _on_tpu
    return jax.lax.platform_dependent(q, k, v, visible, **branches)


@functools.cache
def cudnn_works() -> bool:
    """Return whether cuDNN's attention and its gradient run on the first NVIDIA GPU; tried once.

    Without a GPU, return whether jax lowers it for one: what is compiled here then runs on another machine.
    """

    def loss(x):
        return _with_cudnn(x, x, x, jnp.ones(x.shape[:2], bool)).sum()

    shape = (2, 13, 1, 64)
    try:
        try:
            device = jax.local_devices(backend="cuda")[0]
        except RuntimeError:
            x = jax.ShapeDtypeStruct(shape, jnp.bfloat16)
            jax.jit(jax.grad(loss)).trace(x).lower(lowering_platforms=("cuda",))
            return True
        with jax.ensure_compile_time_eval(), jax.default_device(device):
            jax.block_until_ready(jax.grad(loss)(jnp.ones(shape, jnp.bfloat16)))
    except Exception:  # a library that is missing, too old or too new, or too old a GPU: XLA computes it
        return False
    return True


def _is_on_one_tpu() -> bool:
    """Return whether arrays are on one device: jax cannot divide the work of its kernel for TPUs among several."""
    in_shard_map = bool(jax.sharding.get_abstract_mesh().manual_axes)
    return not in_shard_map and (jax.default_backend() != "tpu" or jax.device_count() == 1)


def _at_once_or_in_chunks(q, k, v, visible):
    """Attend a few hundred queries of all heads at a time where the logits do not fit."""
    B, T, N, D = q.shape
    size = max(LOGITS_AT_ONCE // (B * N * k.shape[1]), 1)  # queries
    if size >= T:
        return _at_once(q, k, v, visible)
    pieces = jnp.pad(q, ((0, 0), (0, -T % size), (0, 0), (0, 0))).reshape(B, -1, size, N, D)
    attend = jax.checkpoint(lambda piece: _at_once(piece, k, v, visible))
    out = jax.lax.map(attend, jnp.moveaxis(pieces, 1, 0))
    return jnp.moveaxis(out, 0, 1).reshape(B, -1, N, D)[:, :T]


def _at_once(q, k, v, visible):
    return jax.nn.dot_product_attention(q, k, v, mask=None if visible is None else visible[:, None, None, :])


@jax.custom_vjp
def _with_cudnn(q, k, v, visible):
    return _packed(*_batched_alike(q, k, v, visible), implementation="cudnn")


def _with_cudnn_forward(q, k, v, visible):
    q, k, v, visible = _batched_alike(q, k, v, visible)
    out, pull = jax.vjp(lambda q, k, v: evened(q, k, v, visible, implementation="cudnn"), q, k, v)
    return out, (q, pull)


def _with_cudnn_backward(residuals, gradient):
    q, pull = residuals
    return *pull(_batched_alike(gradient, q)[0]), None


def _batched_alike(*arrays):
    """Return the arrays, each computed from all: jax's rule for vmap of cuDNN's attention takes no mixture."""
    firsts = [x.reshape(len(x), -1)[:, 0] for x in arrays if x is not None]
    never = functools.reduce(jnp.logical_or, [first != first for first in firsts]) & False  # XLA removes it

    def computed(x):
        return x if x is None else jnp.where(never.reshape(-1, *(1,) * (x.ndim - 1)), jnp.zeros_like(x), x)

    return tuple(map(computed, arrays))


_with_cudnn.defvjp(_with_cudnn_forward, _with_cudnn_backward)


def evened(q, k, v, visible, *, implementation):
    """Attend with even numbers of queries and keys: jax's cuDNN attention refuses gradients of odd ones."""
    T, K = q.shape[1], k.shape[1]
    if T % 2 == K % 2 == 0:
        return _packed(q, k, v, visible, implementation=implementation)

    def even(x):
        return jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), *((0, 0),) * (x.ndim - 2)))

    real = jnp.ones(k.shape[:2], bool) if visible is None else visible
    return _packed(even(q), even(k), even(v), even(real), implementation=implementation)[:, :T]


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


@jax.custom_vjp
def _on_tpu(q, k, v, visible):
    """Run jax's flash attention for TPUs; invisible keys, and the padding of the last block, are another segment."""
    with _products_of(q.dtype):
        return _flash(q, k, v, visible)


def _on_tpu_forward(q, k, v, visible):
    with _products_of(q.dtype):
        return jax.vjp(lambda q, k, v: _flash(q, k, v, visible), q, k, v)


def _on_tpu_backward(pull, gradient):
    with _products_of(gradient.dtype):  # the gradient's products are traced here
        return *pull(gradient), None


_on_tpu.defvjp(_on_tpu_forward, _on_tpu_backward)


def _products_of(dtype):
    """Return a context for the kernel's products: those in bfloat16 have only the default precision."""
    return jax.default_matmul_precision("highest" if dtype == jnp.float32 else "default")


def _flash(q, k, v, visible):
    from jax.experimental.pallas.ops.tpu.flash_attention import SegmentIds, flash_attention

    T, K = q.shape[1], k.shape[1]

    def padded(x):
        return jnp.pad(x, ((0, 0), (0, -x.shape[1] % _TPU_BLOCK), *((0, 0),) * (x.ndim - 2)))

    queries, keys, values = (padded(x).swapaxes(1, 2) for x in (q, k, v))
    segment = padded(jnp.ones((len(k), K), jnp.int32) if visible is None else visible.astype(jnp.int32))
    segments = SegmentIds(jnp.ones((len(q), queries.shape[2]), jnp.int32), segment)
    out = flash_attention(queries, keys, values, segment_ids=segments, sm_scale=q.shape[-1] ** -0.5)
    return out.swapaxes(1, 2)[:, :T]
