"""Where patches are in a frame: rotary embedding in two dimensions, and the backbone's table of positions."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BASE = 100.0
_CUBIC = np.float32(-0.75)  # the slope of PyTorch's kernel at 1
_OFFSET = 0.1  # of the number of patches, in the scale


class Rope(NamedTuple):
    """Cosine and sine of every token's angles: [T, D] each."""

    cos: Float[Array, "T D"]
    sin: Float[Array, "T D"]


def rope_table(grid: tuple[int, int], special_tokens: int, head_dim: int, *, flat: bool = False) -> Rope:
    """Return the angles of `special_tokens` tokens at position 0 followed by a grid of patches counted from 1.

    The first half of a head rotates with y, the second with x. If `flat`, all patches are at (1, 1).
    """
    rows, columns = grid
    y, x = np.meshgrid(np.arange(1, rows + 1), np.arange(1, columns + 1), indexing="ij")
    positions = np.stack([y.ravel(), x.ravel()], axis=-1)  # [P, 2]
    positions = np.ones_like(positions) if flat else positions
    positions = np.concatenate([np.zeros((special_tokens, 2), positions.dtype), positions])  # [T, 2]
    half = head_dim // 2
    frequencies = (1.0 / BASE ** (np.arange(0, half, 2, dtype=np.float32) / half)).astype(np.float32)
    angles = positions.astype(np.float32)[:, :, None] * frequencies  # [T, 2, D/4]
    angles = np.concatenate([angles, angles], axis=-1).reshape(len(positions), head_dim)
    return Rope(jnp.asarray(np.cos(angles)), jnp.asarray(np.sin(angles)))


def apply_rope(x: Float[Array, "T N D"], rope: Rope) -> Float[Array, "T N D"]:
    """Rotate the halves of each of the two sub-vectors (y, x) of every head by the token's angles."""
    parts = x.reshape(*x.shape[:-1], 2, 2, x.shape[-1] // 4)
    rotated = jnp.stack([-parts[..., 1, :], parts[..., 0, :]], axis=-2).reshape(x.shape)
    cos = rope.cos[:, None, :].astype(x.dtype)
    sin = rope.sin[:, None, :].astype(x.dtype)
    return x * cos + rotated * sin


def patch_positions(
    table: Float[Array, "G C"], side: int, grid: tuple[int, int], *, by_scale: bool = False
) -> Float[Array, "P C"]:
    """Resize the learned square grid of positions to `grid`: bicubic, as DINOv2.

    VGGT asks for the size and smooths (antialias). Depth Anything 3 asks for the scale (n + 0.1) / side, as DINOv2's
    first code did, without smoothing.
    """
    if grid == (side, side):
        return table
    C = table.shape[-1]
    table = table.reshape(side, side, C)
    if by_scale:
        rows, columns = (jnp.asarray(_cubic_weights(side, count), table.dtype) for count in grid)
        table = jnp.einsum("hm,wn,mnc->hwc", rows, columns, table)
    else:
        table = jax.image.resize(table, (*grid, C), "cubic", antialias=True)
    return table.reshape(grid[0] * grid[1], C)


def _cubic_weights(side: int, count: int) -> Float[np.ndarray, "count side"]:
    """Return how much each entry of an axis of the table counts for each patch; in float32, as PyTorch does."""
    scale = np.float32(1 / ((count + _OFFSET) / side))
    place = scale * (np.arange(count, dtype=np.float32) + np.float32(0.5)) - np.float32(0.5)
    first = np.floor(place)
    fraction = (place - first)[:, None]
    distance = np.abs(fraction - np.arange(-1, 3, dtype=np.float32))  # to the four entries around it
    a = _CUBIC
    near = ((a + 2) * distance - (a + 3)) * distance * distance + 1
    far = ((a * distance - 5 * a) * distance + 8 * a) * distance - 4 * a
    weights = np.zeros((count, side), np.float32)
    entries = np.clip(first[:, None].astype(int) + np.arange(-1, 3), 0, side - 1)
    np.add.at(weights, (np.arange(count)[:, None], entries), np.where(distance <= 1, near, far))
    return weights
