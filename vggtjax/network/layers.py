"""The leaves of the network as linen modules; how to apply and declare them."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.network.convolution import same_convolution

Params = dict[str, Any]
DType = Any


class Dense(nn.Dense):
    """A linear layer. `init_params` draws its kernel: flax would trace a generator at every declaration and call."""

    kernel_init: Any = nn.initializers.zeros


class Conv(nn.Conv):
    """A convolution, whose kernel `init_params` draws."""

    kernel_init: Any = nn.initializers.zeros


class Conv3x3(Conv):
    """A 3 x 3 convolution of stride 1 that keeps the size of the image."""

    kernel_size: Any = (3, 3)
    conv_general_dilated: Any = same_convolution


class LayerNorm(nn.LayerNorm):
    """Layer norm as PyTorch computes it: two passes for the variance, epsilon 1e-5 by default."""

    epsilon: float = 1e-5
    use_fast_variance: bool = False


class MLP(nn.Module):
    """Dense, exact GELU, dense."""

    hidden: int
    features: int
    dtype: DType = None  # None: the wider type of inputs and parameters

    @nn.compact
    def __call__(self, x: Float[Array, "... C"]) -> Float[Array, "... F"]:
        x = Dense(self.hidden, dtype=self.dtype, name="fc1")(x)
        return Dense(self.features, dtype=self.dtype, name="fc2")(gelu(x))


@jax.custom_vjp
def gelu(x: Array) -> Array:
    """Return x times the normal distribution function of x; the gradient computes both again from x."""
    return x * _normal_cdf(x)


def _gelu_backward(x, gradient):
    density = jnp.exp(-0.5 * x * x) * (2 * math.pi) ** -0.5
    return (gradient * (_normal_cdf(x) + x * density),)


def _normal_cdf(x: Array) -> Array:
    return 0.5 * (1 + jax.lax.erf(x * 0.5**0.5))


gelu.defvjp(lambda x: (gelu(x), x), _gelu_backward)


def apply(module: nn.Module, params: Params, *inputs: Any) -> Any:
    """Run a module with the given parameters."""
    return module.apply({"params": params}, *inputs)


def declare(module: nn.Module, *inputs: Any) -> Params:
    """Return a module's parameters for inputs of these shapes.

    Only names and shapes are used: `model.parameter_shapes` evaluates them abstractly, `model.init_params` draws the
    values.
    """
    return dict(module.init(jax.random.key(0), *inputs)["params"])
