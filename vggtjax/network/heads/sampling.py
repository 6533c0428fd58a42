"""Bilinear sampling at positions x, y that count pixel centres from 0."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def bilinear(image: Float[Array, "H W C"], positions: Float[Array, "*N 2"]) -> Float[Array, "*N C"]:
    """Sample at positions inside [0, W - 1] x [0, H - 1]; differentiable by the image and by the positions."""
    low, high, share = neighbours(positions, (image.shape[0], image.shape[1]))
    x, y = share[..., :1], share[..., 1:]
    top = image[low[..., 1], low[..., 0]] * (1 - x) + image[low[..., 1], high[..., 0]] * x
    bottom = image[high[..., 1], low[..., 0]] * (1 - x) + image[high[..., 1], high[..., 0]] * x
    return top * (1 - y) + bottom * y


def neighbours(
    positions: Float[Array, "*N 2"], size: tuple[int, int]
) -> tuple[Int[Array, "*N 2"], Int[Array, "*N 2"], Float[Array, "*N 2"]]:
    """Return the pixels x, y before and after positions inside an image of H x W, and the share of those after."""
    last = jnp.asarray([size[1] - 1, size[0] - 1]).reshape((1,) * (positions.ndim - 1) + (2,))
    low = jnp.clip(jnp.floor(positions).astype(jnp.int32), 0, jnp.maximum(last - 1, 0))
    return low, jnp.minimum(low + 1, last), positions - low.astype(positions.dtype)
