"""Rotary position embedding in two dimensions (VGGT)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BASE = 100.0


class Rope(NamedTuple):
    """Cosine and sine of every token's angles: [T, D] each."""

    cos: Float[Array, "T D"]
    sin: Float[Array, "T D"]


def rope_table(grid: tuple[int, int], special_tokens: int, head_dim: int) -> Rope:
    """Return the angles of `special_tokens` tokens at position 0 followed by a grid of patches counted from 1.

    The first half of a head rotates with y, the second with x.
    """
    rows, columns = grid
    y, x = np.meshgrid(np.arange(1, rows + 1), np.arange(1, columns + 1), indexing="ij")
    positions = np.stack([y.ravel(), x.ravel()], axis=-1)  # [P, 2]
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
