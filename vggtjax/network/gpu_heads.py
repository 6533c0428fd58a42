"""q, k and v of a block on an NVIDIA GPU in one kernel: the norms of q and k and their rotation.

XLA has nine kernels for it, which read q and k seven times. The kernel is Pallas's, for Triton.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.network.gpu_kernels import compiles_for_gpus, runs
from vggtjax.network.rope import Rope, apply_rope

NAME = "vggtjax_heads"
_EPSILON = 1e-5
_ROWS = 4  # at once, at most

Heads = tuple[Float[Array, "R N D"], Float[Array, "R N D"], Float[Array, "R N D"]]


def is_fused(heads: int, head_dim: int) -> bool:
    """Return whether the kernel takes heads of this number and size: Triton's tiles have sides of powers of 2."""
    return all(n > 0 and n & (n - 1) == 0 for n in (heads, head_dim)) and head_dim >= 4


@functools.cache
def heads_work() -> bool:
    """Return whether the kernel runs on the first NVIDIA GPU; tried once.

    Without a GPU, return whether jax compiles for NVIDIA GPUs here: nothing else pays for tracing the kernel.
    """

    def loss(y: Array) -> Array:
        q, k, v = normed_heads(y, jnp.ones((2, 2, 64)), Rope(jnp.ones((6, 64)), jnp.ones((6, 64))))
        return jnp.sum(q * k + v).astype(jnp.float32)

    return compiles_for_gpus() and all(
        runs(jax.grad(loss), jax.ShapeDtypeStruct((6, 3, 2, 64), dtype)) for dtype in ("bfloat16", "float32")
    )


@jax.custom_vjp
def normed_heads(y: Float[Array, "L 3 N D"], norms: Float[Array, "2 2 D"], rope: Rope) -> Heads:
    """Return q and k after norm and rotation, and v, in the type of y; all between is float32.

    Args:
        y: q, k and v of every row; rows after the R that have angles are ignored.
        norms: scale and bias of the norm of q, and of that of k.
        rope: the angles of every row.
    """
    return fused_heads(y, norms, rope)


def _forward(*inputs):
    return normed_heads(*inputs), inputs


def _backward(inputs, gradient):
    return jax.vjp(heads_by_xla, *inputs)[1](gradient)


normed_heads.defvjp(_forward, _backward)


def heads_by_xla(y: Float[Array, "L 3 N D"], norms: Float[Array, "2 2 D"], rope: Rope) -> Heads:
    """Return `normed_heads` without the kernel."""
    y = y[: len(rope.cos)]
    wide = y[:, :2].astype(jnp.float32)
    normed = (wide - wide.mean(-1, keepdims=True)) * jax.lax.rsqrt(wide.var(-1, keepdims=True) + _EPSILON)
    normed = normed * norms[None, :, :1] + norms[None, :, 1:]
    q, k = (apply_rope(normed[:, i], rope).astype(y.dtype) for i in (0, 1))
    return q, k, y[:, 2]


def fused_heads(y: Float[Array, "R 3 N D"], norms: Float[Array, "2 2 D"], rope: Rope, interpret: bool = False) -> Heads:
    """Return `normed_heads` by the kernel. `interpret` runs it without a GPU, slowly, for tests."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    R, N, D = len(rope.cos), *y.shape[2:]
    rows = math.gcd(R, _ROWS)
    of_heads = pl.BlockSpec((rows, N, D), lambda block: (block, 0, 0))
    of_angles = pl.BlockSpec((rows, D), lambda block: (block, 0))
    head = jax.eval_shape(lambda y: y[:R, 0], y)  # on devices that share frames it varies, as y does
    return pl.pallas_call(
        _kernel,
        grid=(R // rows,),
        in_specs=[
            pl.BlockSpec((rows, 3, N, D), lambda block: (block, 0, 0, 0)),
            pl.BlockSpec((2, 2, D), lambda block: (0, 0, 0)),
            of_angles,
            of_angles,
        ],
        out_specs=(of_heads,) * 3,
        out_shape=(head,) * 3,
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=1),
        interpret=interpret,
        name=NAME,
    )(y, norms, rope.cos, rope.sin)


def _kernel(y_ref, norms_ref, cos_ref, sin_ref, q_ref, k_ref, v_ref) -> None:
    """Compute the heads of some rows, in the four quarters that a rotation exchanges: first with second, and so on."""
    from jax.experimental import pallas as pl

    D = y_ref.shape[-1]
    quarters = [pl.ds(i * (D // 4), D // 4) for i in range(4)]
    for index, out_ref in enumerate((q_ref, k_ref)):
        parts = [y_ref[:, index, :, quarter].astype(jnp.float32) for quarter in quarters]  # [rows, N, D / 4]
        mean = sum(part.sum(axis=-1, keepdims=True) for part in parts) / D
        parts = [part - mean for part in parts]
        variance = sum(jnp.square(part).sum(axis=-1, keepdims=True) for part in parts) / D
        factor = jax.lax.rsqrt(variance + _EPSILON)
        scales, biases = ([norms_ref[index, i, quarter][None, None] for quarter in quarters] for i in (0, 1))
        parts = [part * (factor * scale) + bias for part, scale, bias in zip(parts, scales, biases, strict=True)]
        rotated = (-parts[1], parts[0], -parts[3], parts[2])
        for quarter, part, turned in zip(quarters, parts, rotated, strict=True):
            cos, sin = (ref[:, quarter][:, None] for ref in (cos_ref, sin_ref))
            out = part * cos + turned * sin
            out_ref[:, :, quarter] = out.astype(out_ref.dtype)
    v_ref[...] = y_ref[:, 2]
