"""Scaled dot-product attention, with the fastest implementation for each platform."""

from __future__ import annotations

import functools
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.network.cpu_attention import attention_in_chunks
from vggtjax.network.gpu_attention import fused_attention, is_fused
from vggtjax.network.gpu_kernels import compiles_for_gpus, is_in_shard_map, is_on_one, runs
from vggtjax.network.pieces import largest_divisor

LOGITS_AT_ONCE = 2**28  # maximum of all clips and heads in memory, except on a CPU
_TPU_BLOCK = 128  # tokens in a block of the kernel for TPUs: lengths are multiples of it


def attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    visible: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B T N D"]:
    """Return softmax(q k^T / sqrt(D)) v; only `visible` keys enter the softmax, at least one of every clip.

    A CPU computes one head and a few hundred queries at a time: several times faster than all at once, in little
    memory. NVIDIA GPUs use cuDNN's flash attention for bfloat16 and a kernel of `gpu_attention` for float32, TPUs jax's
    own kernel. Elsewhere attention is computed at once where the logits fit in memory, otherwise in chunks.
    """
    branches: dict[str, Any] = {"cpu": attention_in_chunks, "default": _at_once_or_in_chunks}
    D = q.shape[-1]
    # The platform that the program is compiled for chooses, whether or not one is plugged in.
    if q.dtype == jnp.bfloat16 and D % 8 == 0 and D <= 128 and cudnn_works():
        branches["cuda"] = _with_cudnn
    if q.dtype == jnp.float32 and is_fused(D) and is_on_one("gpu") and kernel_works():
        branches["cuda"] = _in_one_kernel
    if (D <= 128 or D % 128 == 0) and not is_in_shard_map() and is_on_one("tpu") and find_spec("libtpu"):
        branches["tpu"] = _on_tpu
    return jax.lax.platform_dependent(q, k, v, visible, **branches)


@functools.cache
def cudnn_works() -> bool:
    """Return whether cuDNN's attention and its gradient run on the first NVIDIA GPU; tried once.

    Without a GPU, return whether cuDNN is installed: what is compiled for a GPU here runs on another machine.
    """
    return _attends(_with_cudnn, jnp.bfloat16, 64)


@functools.cache
def kernel_works() -> bool:
    """Return whether the kernel for float32 runs on the first NVIDIA GPU; tried once.

    Without a GPU, return whether jax compiles for NVIDIA GPUs here: nothing else pays for tracing the kernel.
    """
    return compiles_for_gpus() and all(_attends(_in_one_kernel, jnp.float32, head_dim) for head_dim in (64, 128))


def _attends(attend, dtype, head_dim: int) -> bool:
    visible = np.ones((2, 13), bool)
    gradient = jax.grad(lambda x: attend(x, x, x, jnp.asarray(visible)).sum())
    return runs(gradient, jax.ShapeDtypeStruct((2, 13, 1, head_dim), dtype))


def _at_once_or_in_chunks(q, k, v, visible):
    clips = LOGITS_AT_ONCE // (q.shape[2] * q.shape[1] * k.shape[1])  # at once
    if clips >= q.shape[0]:
        return _at_once(q, k, v, visible)
    if clips == 0:
        return attention_in_chunks(q, k, v, visible)
    clips = largest_divisor(q.shape[0], clips)
    pieces = jax.tree.map(lambda x: x.reshape(-1, clips, *x.shape[1:]), (q, k, v, visible))
    return jax.lax.map(lambda piece: _at_once(*piece), pieces).reshape(q.shape)


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


@jax.custom_vjp
def _in_one_kernel(q, k, v, visible):
    return fused_attention(q, k, v, visible)


def _in_one_kernel_forward(q, k, v, visible):
    return _in_one_kernel(q, k, v, visible), (q, k, v, visible)


def _in_one_kernel_backward(inputs, gradient):
    """Compute the attention again, in chunks: training in float32 on a GPU is for checks."""
    *inputs, visible = inputs
    return *jax.vjp(lambda q, k, v: _at_once_or_in_chunks(q, k, v, visible), *inputs)[1](gradient), None


_in_one_kernel.defvjp(_in_one_kernel_forward, _in_one_kernel_backward)


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
