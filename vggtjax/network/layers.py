"""The leaves of the network as linen modules, and stacks of equal layers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax.linen.dtypes import promote_dtype
from jaxtyping import Array, Float

from vggtjax.network.kernels.cpu_convolution import same_convolution
from vggtjax.network.precision import upcast

Params = dict[str, Any]
DType = Any
_State = TypeVar("_State")


class Dense(nn.Module):
    """A linear layer, whose kernel `init_params` draws. Products in bfloat16 have outputs in float32."""

    features: int
    dtype: DType = None  # of the product; None: the wider type of inputs and parameters
    activate: bool = False  # by GELU: exact, or its tanh form for bfloat16 on an accelerator

    @nn.compact
    def __call__(self, x: Float[Array, "... I"]) -> Float[Array, "... F"]:
        kernel = self.param("kernel", nn.initializers.zeros, (x.shape[-1], self.features), jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (self.features,), jnp.float32)
        x, kernel, bias = promote_dtype(x, kernel, bias, dtype=self.dtype)
        bias = bias.reshape((1,) * (x.ndim - 1) + (-1,))
        exact, fused = (gelu, _fused_gelu) if self.activate else (_unchanged, _unchanged)
        if x.dtype != jnp.bfloat16:
            return exact(x @ kernel + bias)

        def wide(x: Array, kernel: Array, bias: Array) -> Array:
            """A CPU multiplies bfloat16 twice as fast with sums and outputs in float32."""
            return exact(jnp.matmul(x, kernel, preferred_element_type=jnp.float32) + bias.astype(jnp.float32))

        def narrow(x: Array, kernel: Array, bias: Array) -> Array:
            """An accelerator writes bfloat16, and widens it in the kernel that reads it."""
            return fused(x @ kernel + bias).astype(jnp.float32)

        return jax.lax.platform_dependent(x, kernel, bias, cpu=wide, default=narrow)


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
    """Dense, GELU, dense."""

    hidden: int
    features: int
    dtype: DType = None  # as of `Dense`

    @nn.compact
    def __call__(self, x: Float[Array, "... C"]) -> Float[Array, "... F"]:
        x = Dense(self.hidden, dtype=self.dtype, activate=True, name="fc1")(x)
        return Dense(self.features, dtype=self.dtype, name="fc2")(x)


@jax.custom_vjp
def gelu(x: Array) -> Array:
    """Return x times the normal distribution function of x; the gradient computes both again from x."""
    return x * _normal_cdf(x)


def _gelu_backward(x, gradient):
    wide = upcast(x)
    density = jnp.exp(-0.5 * wide * wide) * (2 * math.pi) ** -0.5
    return ((gradient * (_normal_cdf(wide) + wide * density)).astype(x.dtype),)


def _normal_cdf(x: Array) -> Array:
    return 0.5 * (1 + jax.lax.erf(x * 0.5**0.5))


gelu.defvjp(lambda x: (gelu(x), x), _gelu_backward)


@jax.custom_vjp
def _fused_gelu(x: Array) -> Array:
    """Return GELU by tanh, off by at most 5e-4: cuBLAS applies it as it writes a product."""
    return jax.nn.gelu(x, approximate=True)


_fused_gelu.defvjp(lambda x: (_fused_gelu(x), x), _gelu_backward)


def _unchanged(x: Array) -> Array:
    return x


def apply(module: nn.Module, params: Params, *inputs: Any, **options: Any) -> Any:
    """Run a module with the given parameters."""
    return module.apply({"params": params}, *inputs, **options)


def stack(parent: nn.Module, name: str, layer: nn.Module, depth: int, *inputs: Any) -> Params:
    """Return the parameters of `depth` equal layers, stacked on axis 0: a parameter of `parent`, which may scan them.

    `inputs` are those of one layer; only their shapes are used, and only to declare the parameters.
    """
    if not parent.is_initializing():
        return dict(parent.get_variable("params", name))

    def declare(key: Array) -> Params:
        shapes = jax.eval_shape(layer.init, key, *inputs)["params"]
        return jax.tree.map(lambda leaf: jnp.zeros((depth, *leaf.shape), leaf.dtype), shapes)

    return parent.param(name, declare)


def iterate(parent: nn.Module, step: Callable[[_State], _State], start: _State, count: int) -> _State:
    """Return `step` applied `count` times: a loop of jax, or a single step while `parent` declares its parameters."""
    if parent.is_initializing():
        return step(start)
    return jax.lax.scan(lambda state, _: (step(state), None), start, length=count)[0]
