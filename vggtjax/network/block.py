"""The transformer block: attention and MLP, pre-norm, with LayerScale (DINOv2, VGGT)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from vggtjax.network.attention import ATTENDED
from vggtjax.network.layers import MLP, Dense, DType, LayerNorm, Params, apply, declare
from vggtjax.network.pieces import in_pieces, replaced_in_pieces
from vggtjax.network.quantised import dequantised
from vggtjax.network.rope import Rope, apply_rope
from vggtjax.network.suppression import Attend, SuppressedKeys, suppressed_attention

_STORED = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.dots_with_no_batch_dims_saveable, jax.checkpoint_policies.save_only_these_names(ATTENDED)
)


def storing_little(step: Callable, *, remat: bool) -> Callable:
    """Return the step of a scan over blocks with little stored for its gradient.

    It keeps the outputs of linear layers and of attention, as all else is cheap to compute again, or with `remat` the
    step's input alone.
    """
    return jax.checkpoint(step, prevent_cse=False, policy=None if remat else _STORED)


@dataclass(frozen=True)
class Block:
    """A block as a function of its parameters. The residual stream keeps the input's dtype.

    Only attention mixes tokens; the layers before and after it run over pieces of the tokens.
    """

    num_heads: int
    qk_norm: bool = False
    epsilon: float = 1e-5
    dtype: DType = jnp.float32
    attend: Attend = suppressed_attention

    def __call__(
        self,
        params: Params,
        x: Float[Array, "B L C"],
        rope: Rope | None = None,
        suppressed: SuppressedKeys | None = None,
        is_real: Bool[Array, "B L"] | None = None,
    ) -> tuple[Float[Array, "B L C"], Float[Array, "B L N D"], Float[Array, "B L N D"]]:
        """Return the tokens after the block, and q and k after norm and rotation, for the motion cues.

        Args:
            params: the block's own, as `declare` declares them; kernels may be `Quantised`.
            x: B sequences of L tokens.
            rope: the angles of T tokens, where L is a multiple of T; or None.
            suppressed: the keys to suppress, or None.
            is_real: tokens that others attend to; None for all.
        """
        B, L, C = x.shape
        params = dequantised(params)
        heads = (self.num_heads, C // self.num_heads)
        tokens = x.reshape(B * L, C)

        def before(rows):
            x, place = rows
            y = apply(LayerNorm(self.epsilon, dtype=self.dtype), params["norm1"], x)
            y = apply(Dense(3 * C, dtype=self.dtype), params["attention"]["qkv"], y).reshape(-1, 3, *heads)
            q, k, v = (y[:, i] for i in range(3))  # [R, N, D]
            if self.qk_norm:
                q = apply(LayerNorm(dtype=self.dtype), params["attention"]["q_norm"], q)
                k = apply(LayerNorm(dtype=self.dtype), params["attention"]["k_norm"], k)
            if rope is not None:
                angles = Rope(rope.cos[place], rope.sin[place])
                q, k = apply_rope(q, angles), apply_rope(k, angles)
            return q, k, v

        def after(x, y):
            y = apply(Dense(C, dtype=self.dtype), params["attention"]["projection"], y)
            x = add(x, "scale1", y)
            y = apply(LayerNorm(self.epsilon, dtype=self.dtype), params["norm2"], x)
            return add(x, "scale2", apply(MLP(4 * C, C, self.dtype), params["mlp"], y))

        def add(x, scale, y):
            return x + params[scale].astype(x.dtype)[None, :] * y.astype(x.dtype)

        place = jnp.arange(B * L) % (L if rope is None else rope.cos.shape[0])
        q, k, v = (y.reshape(B, L, *heads) for y in in_pieces(before, (tokens, place)))
        y = self.attend(q, k, v, suppressed, is_real).reshape(B * L, C)
        return replaced_in_pieces(after, tokens, y).reshape(B, L, C), q, k

    def declare(self, C: int) -> Params:
        """Declare the parameters of a block for tokens of C channels."""

        def declared(module: nn.Module, channels: int) -> Params:
            return declare(module, jnp.zeros((1, channels)))

        attention = {"qkv": declared(Dense(3 * C), C), "projection": declared(Dense(C), C)}
        if self.qk_norm:
            norm = declared(LayerNorm(), C // self.num_heads)
            attention |= {"q_norm": norm, "k_norm": norm}
        return {
            "norm1": declared(LayerNorm(), C),
            "attention": attention,
            "scale1": jnp.ones(C),
            "norm2": declared(LayerNorm(), C),
            "mlp": declared(MLP(4 * C, C), C),
            "scale2": jnp.ones(C),
        }

    def declare_stacked(self, depth: int, C: int) -> Params:
        """Declare the parameters of `depth` blocks, stacked on axis 0."""
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (depth, *leaf.shape)), self.declare(C))
