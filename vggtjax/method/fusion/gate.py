"""A small convolutional gate, the most flexible part of the family: it shifts both log precisions of every pixel."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

CHANNELS = 16


class Gate(nn.Module):
    """Two 3 x 3 convolutions and a last layer of zeros: an untrained gate changes nothing."""

    @nn.compact
    def __call__(self, x: Float[Array, "F H W C"]) -> Float[Array, "F H W 2"]:
        for i in range(2):
            x = nn.gelu(nn.Dense(CHANNELS, name=f"conv{i}")(_neighbourhoods(x)))
        return nn.Dense(2, kernel_init=nn.initializers.zeros, name="shift")(x)


def _neighbourhoods(x: Float[Array, "F H W C"]) -> Float[Array, "F H W 9C"]:
    """Concatenate the 3 x 3 pixels around each pixel: XLA has no fast gradient of a convolution inside a loop."""
    H, W = x.shape[1:3]
    x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return jnp.concatenate([x[:, i : i + H, j : j + W] for i in range(3) for j in range(3)], axis=-1)


def init_gate(key: Array, inputs: int) -> dict[str, Any]:
    """Return the gate's parameters for `inputs` maps."""
    return dict(Gate().init(key, jnp.zeros((1, 3, 3, inputs)))["params"])


def apply_gate(params: dict[str, Any], maps: Float[Array, "H W C"]) -> Float[Array, "H W 2"]:
    """Return the shifts of the log precision of each pass."""
    with jax.default_matmul_precision("highest"):
        return Gate().apply({"params": params}, maps[None])[0]  # pyright: ignore[reportIndexIssue]
