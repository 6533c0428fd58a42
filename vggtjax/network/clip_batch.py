"""A batch of clips as the network reads it."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Float, Int


class ClipBatch(NamedTuple):
    """Images of a batch of clips, and what travels with them through every pass."""

    images: Float[Array, "B S H W 3"]  # RGB in [0, 1]
    patch_tokens: Float[Array, "B S P C"] | None = None  # what `encode` returned; a pass without them computes them
    frame_count: Int[Array, " B"] | None = None  # real frames of each clip, its first ones, at least one; None: all
