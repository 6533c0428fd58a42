"""A map of patches -> a map of pixels that ends where the frames' colours change (a cross-bilateral filter)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_TAPS = 9  # in each direction, over two patches
_SPREAD = 0.625  # patches; standard deviation in space
_COLOUR = 0.1  # standard deviation of colours in [0, 1]


def follow_edges(
    values: Float[Array, "B S H W"], images: Float[Array, "B S H W 3"], patch_size: int
) -> Float[Array, "B S H W"]:
    """Return the mean of the values around every pixel, weighted by distance and by likeness of colour.

    Args:
        values: a map of patches, resized to pixels.
        images: RGB in [0, 1].
        patch_size: in pixels; the weights reach one patch in each direction.
    """
    shifts = np.unique(np.linspace(-patch_size, patch_size, _TAPS).round().astype(int))
    edge = ((0, 0), (0, 0), (patch_size, patch_size), (patch_size, patch_size))
    padded = jnp.pad(values, edge, mode="edge")
    colours = jnp.pad(images, (*edge, (0, 0)), mode="edge")
    near = np.array([(y, x) for y in shifts for x in shifts])
    distance = (near**2).sum(axis=1) / (2 * (_SPREAD * patch_size) ** 2)

    def add(sums: tuple[Array, Array], tap: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        (y, x), far = tap
        value = jax.lax.dynamic_slice(padded, (0, 0, y, x), values.shape)
        colour = jax.lax.dynamic_slice(colours, (0, 0, y, x, 0), images.shape)
        weight = jnp.exp(-jnp.sum((colour - images) ** 2, axis=-1) / (2 * _COLOUR**2) - far)
        return (sums[0] + weight * value, sums[1] + weight), None

    zeros = 0 * values  # on several devices, as the values are
    taps = (jnp.asarray(near + patch_size), jnp.asarray(distance, jnp.float32))
    (total, weight), _ = jax.lax.scan(add, (zeros, zeros), taps)
    return total / weight
