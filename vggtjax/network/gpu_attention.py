"""Float32 attention on an NVIDIA GPU in one kernel, which never stores a logit (FlashAttention, arXiv 2205.14135).

cuDNN's fused attention takes no float32. The kernel is Pallas's, for Triton; its products are float32, not TF32.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

NAME = "vggtjax_attention"
BLOCKS = {16: 64, 32: 64, 64: 64, 128: 32}  # head size -> queries and keys at once, as shared memory allows
_HIDDEN = -1e30  # logit of a key that is not visible; finite, as a block may have such keys alone


def is_fused(head_dim: int) -> bool:
    """Return whether the kernel takes heads of this size: Triton multiplies powers of 2 from 16 on."""
    return head_dim in BLOCKS


def fused_attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B K N D"],
    v: Float[Array, "B K N D"],
    visible: Bool[Array, "B K"] | None,
    interpret: bool = False,
) -> Float[Array, "B T N D"]:
    """Return `attention` of float32 arrays. `interpret` runs the kernel without a GPU, slowly, for tests."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    (B, T, N, D), K = q.shape, k.shape[1]
    size = BLOCKS[D]

    def whole_blocks(x: Array) -> Array:
        return jnp.pad(x, ((0, 0), (0, -x.shape[1] % size), *((0, 0),) * (x.ndim - 2)))

    hidden = ~whole_blocks(jnp.ones((B, K), bool) if visible is None else visible)
    bias = jnp.where(hidden, jnp.float32(_HIDDEN), 0)
    queries, keys, values = (whole_blocks(x) for x in (q, k, v))
    of_queries = pl.BlockSpec((None, size, None, D), lambda block, clip, head: (clip, block, head, 0))
    of_keys = pl.BlockSpec((None, keys.shape[1], None, D), lambda block, clip, head: (clip, 0, head, 0))
    out = pl.pallas_call(
        functools.partial(_kernel, scale=D**-0.5),
        grid=(queries.shape[1] // size, B, N),
        in_specs=[
            of_queries,
            of_keys,
            of_keys,
            pl.BlockSpec((None, keys.shape[1]), lambda block, clip, head: (clip, 0)),
        ],
        out_specs=of_queries,
        out_shape=jax.eval_shape(lambda x: x, queries),
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=2),
        interpret=interpret,
        name=NAME,
    )(queries, keys, values, bias)
    return out[:, :T]


def _kernel(q_ref, k_ref, v_ref, bias_ref, out_ref, *, scale: float) -> None:
    """Attend with a block of queries of one head; keys pass by in blocks."""
    from jax.experimental import pallas as pl

    size = q_ref.shape[0]
    queries = q_ref[...] * scale
    product = functools.partial(jnp.dot, precision=jax.lax.Precision.HIGHEST, preferred_element_type=jnp.float32)

    def step(block, state):
        out, largest, total = state
        here = pl.ds(block * size, size)
        logits = product(queries, k_ref[here, :].T) + bias_ref[here][None, :]
        now = jnp.maximum(largest, logits.max(axis=1))
        weights, shrink = jnp.exp(logits - now[:, None]), jnp.exp(largest - now)
        return out * shrink[:, None] + product(weights, v_ref[here, :]), now, total * shrink + weights.sum(axis=1)

    start = (jnp.zeros(queries.shape), jnp.full(size, _HIDDEN, jnp.float32), jnp.zeros(size))
    out, _, total = jax.lax.fori_loop(0, k_ref.shape[0] // size, step, start)
    out_ref[...] = out / total[:, None]
