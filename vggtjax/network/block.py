"""The transformer block: attention and MLP, pre-norm, with LayerScale (DINOv2, VGGT)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.network.kernels.attention import attention
from vggtjax.network.kernels.cpu_attention import ATTENDED
from vggtjax.network.kernels.pieces import map_chunks, map_chunks_in_place
from vggtjax.network.kernels.quantised import as_multiplied
from vggtjax.network.layers import MLP, Dense, DType, LayerNorm, constant
from vggtjax.network.positions import Rope, apply_rope

_STORED = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.dots_with_no_batch_dims_saveable, jax.checkpoint_policies.save_only_these_names(ATTENDED)
)


def activations(*, remat: bool) -> Callable[..., Any]:
    """Return the policy by which a loop over blocks stores activations for its gradient, beside its carry.

    They are the outputs of linear layers and, on a CPU, of attention, as all else is cheap to compute again; with
    `remat`, none.
    """
    return jax.checkpoint_policies.nothing_saveable if remat else _STORED


class Projections(nn.Module):
    """The linear layers of attention: before the softmax to q, k and v, after it back to the residual stream."""

    num_heads: int
    channels: int
    qk_norm: bool
    dtype: DType

    def setup(self) -> None:
        self.qkv = Dense(3 * self.channels, dtype=self.dtype)
        self.projection = Dense(self.channels, dtype=self.dtype)
        if self.qk_norm:
            self.q_norm, self.k_norm = LayerNorm(dtype=self.dtype), LayerNorm(dtype=self.dtype)

    def heads(self, x: Float[Array, "R C"], rope: Rope | None, count: int) -> tuple[Array, Array, Array]:
        """Return q, k and v [count, N, D]; q and k after norm, and rotated by their rows' angles.

        Rows from `count` on only pad the product.
        """
        y = self.qkv(x).reshape(-1, 3, self.num_heads, self.channels // self.num_heads)
        q, k, v = (y[:count, i] for i in range(3))
        if self.qk_norm:
            q, k = self.q_norm(q), self.k_norm(k)
        q, k, v = (y.astype(self.dtype) for y in (q, k, v))
        if rope is None:
            return q, k, v
        rope = Rope(rope.cos[:count], rope.sin[:count])
        return apply_rope(q, rope), apply_rope(k, rope), v

    def project(self, y: Float[Array, "R C"]) -> Float[Array, "R C"]:
        """Return what attention adds to the residual stream."""
        return self.projection(y)


class Block(nn.Module):
    """A block. The residual stream keeps the input's dtype.

    Only attention mixes tokens; the layers before and after it run over pieces of the tokens.
    """

    num_heads: int
    qk_norm: bool = False
    epsilon: float = 1e-5
    dtype: DType = jnp.float32
    layer_scale: float = 0.01  # at the start
    gated_mlp: int = 0  # hidden channels of SwiGLU; 0: GELU with 4 C

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "B L C"],
        rope: Rope | None = None,
        attend: Callable[[Array, Array, Array], Array] = attention,
    ) -> tuple[Float[Array, "B L C"], Float[Array, "B L N D"], Float[Array, "B L N D"]]:
        """Return the tokens after the block, and q and k after norm and rotation, for the motion cues.

        Args:
            x: B sequences of L tokens.
            rope: the angles of T tokens, where L is a multiple of T; or None.
            attend: attention within each sequence, from q, k and v [B, L, N, D] to the averaged values.
        """
        B, L, C = x.shape
        projections = Projections(self.num_heads, C, self.qk_norm, self.dtype, name="attention")
        norm1, norm2 = (LayerNorm(self.epsilon, dtype=self.dtype, name=name) for name in ("norm1", "norm2"))
        scale1, scale2 = (self.param(name, constant(self.layer_scale), (C,)) for name in ("scale1", "scale2"))
        hidden = self.gated_mlp or 4 * C
        mlp = MLP(hidden, C, gated=self.gated_mlp > 0, dtype=self.dtype, name="mlp")

        def before(rows, count):
            x, place = rows
            angles = None if rope is None else Rope(rope.cos[place], rope.sin[place])
            return projections.heads(norm1(x), angles, count)

        def after(x, y):
            x = add(x, scale1, projections.project(y))
            return add(x, scale2, mlp(norm2(x)))

        def add(x, scale, y):
            return x + scale.astype(x.dtype)[None, :] * y.astype(x.dtype)

        tokens = x.reshape(B * L, C)
        place = jnp.arange(B * L) % (L if rope is None else rope.cos.shape[0])
        q, k, v = (y.reshape(B, L, *y.shape[1:]) for y in map_chunks(before, (tokens, place)))
        y = attend(q, k, v).reshape(B * L, C)
        return map_chunks_in_place(after, tokens, y).reshape(B, L, C), q, k


# A block whose kernels may be kept in 8 bits or as bits of bfloat16: those of one layer at a time become floats.
PackedBlock: Any = nn.map_variables(Block, "params", as_multiplied, init=True)


class BlockLayer(nn.Module):
    """A block as the body of a loop over layers."""

    block: Block
    attend: Callable[[Array, Array, Array], Array] = attention
    returns_first: bool = False

    def __call__(self, x: Float[Array, "B L C"], _: None = None) -> tuple[Float[Array, "B L C"], Array | None]:
        """Return the tokens after the block, and perhaps the first token of each sequence before it."""
        return self.block(x, attend=self.attend)[0], x[:, 0] if self.returns_first else None
