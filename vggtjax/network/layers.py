"""The leaves of the network as linen modules: layer norm, MLP, attention, transformer block."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.network.attention import Suppression, suppressed_attention
from vggtjax.network.rope import Rope, apply_rope

Params = dict[str, Any]
DType = Any


class LayerNorm(nn.LayerNorm):
    """Layer norm as PyTorch computes it: two passes for the variance, epsilon 1e-5 unless said otherwise."""

    epsilon: float = 1e-5
    use_fast_variance: bool = False


class MLP(nn.Module):
    """Dense, exact GELU, dense."""

    hidden: int
    features: int
    dtype: DType = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "... C"]) -> Float[Array, "... F"]:
        x = nn.Dense(self.hidden, dtype=self.dtype, name="fc1")(x)
        return nn.Dense(self.features, dtype=self.dtype, name="fc2")(nn.gelu(x, approximate=False))


class Attention(nn.Module):
    """Multi-head self-attention; also returns q and k after norm and rotation, which the motion cues read."""

    num_heads: int
    qk_norm: bool = False
    dtype: DType = jnp.float32

    @nn.compact
    def __call__(
        self, x: Float[Array, "B T C"], rope: Rope | None = None, suppression: Suppression | None = None
    ) -> tuple[Float[Array, "B T C"], Float[Array, "B T N D"], Float[Array, "B T N D"]]:
        B, T, C = x.shape
        qkv = nn.Dense(3 * C, dtype=self.dtype, name="qkv")(x).reshape(B, T, 3, self.num_heads, C // self.num_heads)
        q, k, v = (qkv[:, :, i] for i in range(3))  # [B, T, N, D]
        if self.qk_norm:
            q = LayerNorm(dtype=self.dtype, name="q_norm")(q)
            k = LayerNorm(dtype=self.dtype, name="k_norm")(k)
        if rope is not None:
            q, k = apply_rope(q, rope), apply_rope(k, rope)
        out = suppressed_attention(q, k, v, suppression).reshape(B, T, C)
        return nn.Dense(C, dtype=self.dtype, name="projection")(out), q, k


class Block(nn.Module):
    """Pre-norm transformer block with LayerScale. The residual stream keeps the input's dtype."""

    num_heads: int
    qk_norm: bool = False
    epsilon: float = 1e-5
    dtype: DType = jnp.float32

    @nn.compact
    def __call__(
        self, x: Float[Array, "B T C"], rope: Rope | None = None, suppression: Suppression | None = None
    ) -> tuple[Float[Array, "B T C"], Float[Array, "B T N D"], Float[Array, "B T N D"]]:
        C = x.shape[-1]

        def add(x, name, y):
            scale = self.param(name, nn.initializers.ones, (C,))
            return x + scale.astype(x.dtype)[None, None, :] * y.astype(x.dtype)

        y = LayerNorm(self.epsilon, dtype=self.dtype, name="norm1")(x)
        y, q, k = Attention(self.num_heads, self.qk_norm, self.dtype, name="attention")(y, rope, suppression)
        x = add(x, "scale1", y)
        y = LayerNorm(self.epsilon, dtype=self.dtype, name="norm2")(x)
        return add(x, "scale2", MLP(4 * C, C, self.dtype, name="mlp")(y)), q, k


def apply(module: nn.Module, params: Params, *inputs: Any) -> Any:
    """Run a module on its own parameters."""
    return module.apply({"params": params}, *inputs)


def declare(module: nn.Module, *inputs: Any) -> Params:
    """Return a module's parameters for inputs of these shapes.

    Only names and shapes count: `model.parameter_shapes` evaluates this without computing, `model.init_params` draws.
    """
    return dict(module.init(jax.random.key(0), *inputs)["params"])


def declare_stacked(module: nn.Module, depth: int, *inputs: Any) -> Params:
    """Return the parameters of `depth` copies of a module, stacked on axis 0."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (depth, *leaf.shape)), declare(module, *inputs))
