"""A batch of clips as the network reads it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class ClipBatch(NamedTuple):
    """Images of a batch of clips, and what travels with them through every pass."""

    images: Float[Array, "B S H W 3"]  # RGB in [0, 1]
    patch_tokens: Float[Array, "B S P C"] | None = None  # what `encode` returned; a pass without them computes them
    frame_count: Int[Array, " B"] | None = None  # real frames of each clip, its first ones, at least one; None: all


def real_frames(frame_count: Int[Array, " B"] | None, S: int) -> Bool[Array, "B S"] | None:
    """Return which of S frames are real, or None if all are."""
    return None if frame_count is None else jnp.arange(S)[None] < frame_count[:, None]
