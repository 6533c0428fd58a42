"""The leaves of the network as linen modules, loops over equal layers, and how parameters start."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct
from flax.core.meta import AxisMetadata
from flax.linen.dtypes import promote_dtype
from jaxtyping import Array, Float

from vggtjax.network.kernels.cpu_convolution import same_convolution
from vggtjax.network.precision import upcast

Params = dict[str, Any]
DType = Any
_State = TypeVar("_State")
Mean = float | tuple[float, ...]  # of all numbers of a parameter, or of each output channel


class Start(struct.PyTreeNode, AxisMetadata[Any]):
    """A declared parameter, and how `init_params` draws it: normally distributed, or constant where the spread is 0."""

    value: Any
    mean: Mean = struct.field(pytree_node=False)
    spread: float = struct.field(pytree_node=False)

    def unbox(self) -> Any:
        """Return the parameter."""
        return self.value

    def replace_boxed(self, val: Any) -> Start:
        """Return the same start of another parameter."""
        return self.replace(value=val)

    def add_axis(self, index: int, params: dict[Any, Any]) -> Start:
        """Return the same start for a stack of layers."""
        return self

    def remove_axis(self, index: int, params: dict[Any, Any]) -> Start:
        """Return the same start of one layer."""
        return self


def constant(mean: Mean) -> nn.initializers.Initializer:
    """Declare a parameter that starts at one value, or at one of every channel.

    The value is in the `Start`; what flax's own `init` makes of it are zeros, here and below.
    """
    return lambda key, shape, dtype=jnp.float32: Start(jnp.zeros(shape, dtype), mean, 0.0)


def normal(spread: float) -> nn.initializers.Initializer:
    """Declare a parameter that starts with a normal distribution around 0."""
    return lambda key, shape, dtype=jnp.float32: Start(jnp.zeros(shape, dtype), 0.0, spread)


def by_fan_in(gain: float = 1.0) -> nn.initializers.Initializer:
    """Declare a kernel whose outputs have the variance of its inputs, times the squared gain."""
    return lambda key, shape, dtype=jnp.float32: normal(gain * np.prod(shape[:-1]) ** -0.5)(key, shape, dtype)


ZEROS, ONES, TABLE = constant(0.0), constant(1.0), normal(0.02)


class Dense(nn.Module):
    """A linear layer. Outputs of products in bfloat16 have the type float32, but a CPU alone gives them its digits."""

    features: int
    dtype: DType = None  # of the product; None: the wider type of inputs and parameters
    activate: bool = False  # by GELU: exact, or its tanh form for bfloat16 on an accelerator
    gain: float = 1.0  # of the kernel's start
    bias_start: Mean = 0.0

    @nn.compact
    def __call__(self, x: Float[Array, "... I"]) -> Float[Array, "... F"]:
        kernel = self.param("kernel", by_fan_in(self.gain), (x.shape[-1], self.features), jnp.float32)
        bias = self.param("bias", constant(self.bias_start), (self.features,), jnp.float32)
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
    """flax's convolution, which starts by its fan-in."""

    kernel_init: Any = by_fan_in()
    bias_init: Any = ZEROS


class Conv3x3(Conv):
    """A 3 x 3 convolution of stride 1 that keeps the size of the image."""

    kernel_size: Any = (3, 3)
    conv_general_dilated: Any = same_convolution


class LayerNorm(nn.LayerNorm):
    """Layer norm as PyTorch computes it: two passes for the variance, epsilon 1e-5 by default."""

    epsilon: float = 1e-5
    use_fast_variance: bool = False
    scale_init: Any = ONES
    bias_init: Any = ZEROS


class MLP(nn.Module):
    """Dense, GELU, dense; if `gated`, SwiGLU: silu(first half) times second half between the two."""

    hidden: int
    features: int
    gated: bool = False
    dtype: DType = None  # as of `Dense`
    gain: float = 1.0  # of the last kernel's start
    bias_start: Mean = 0.0  # of the last bias

    @nn.compact
    def __call__(self, x: Float[Array, "... C"]) -> Float[Array, "... F"]:
        if self.gated:
            gate, x = jnp.split(Dense(2 * self.hidden, dtype=self.dtype, name="fc1")(x), 2, axis=-1)
            x = nn.silu(gate) * x
        else:
            x = Dense(self.hidden, dtype=self.dtype, activate=True, name="fc1")(x)
        return Dense(self.features, dtype=self.dtype, gain=self.gain, bias_start=self.bias_start, name="fc2")(x)


@jax.custom_vjp
def gelu(x: Array) -> Array:
    """Return x times the normal distribution function of x; the gradient computes that again from x."""
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
    """Return GELU by tanh, off by at most 5e-4, with the exact one's gradient: cuBLAS applies it as it writes."""
    return jax.nn.gelu(x, approximate=True)


_fused_gelu.defvjp(lambda x: (_fused_gelu(x), x), _gelu_backward)


def _unchanged(x: Array) -> Array:
    return x


def over_layers(layer: type[nn.Module], depth: int, *, store: Any = None) -> Any:
    """Return a class of modules that run `depth` equal layers, (carry, inputs) -> (carry, None), in a loop.

    Parameters and inputs have an axis of layers in front. `store` is a policy of `jax.checkpoint`: which activations of
    a layer are stored for the gradient; None: all.
    """
    step: Any = layer if store is None else nn.remat(layer, prevent_cse=False, policy=store)
    loop = {"variable_axes": {"params": 0}, "split_rngs": {"params": True}, "length": depth}
    return nn.scan(step, **loop, check_constancy_invariants=False)  # the check would trace each layer twice


def repeated(parent: nn.Module, step: Callable[[_State], _State], start: _State, count: int) -> _State:
    """Return `step` applied `count` times: a loop of jax, or a single step while `parent` declares its parameters."""
    if parent.is_initializing():
        return step(start)
    return jax.lax.scan(lambda state, _: (step(state), None), start, length=count)[0]
