"""Pyramids of square tiles. Does not import jax: processes that render read it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def texels(tiles: Sequence[UInt8[np.ndarray, "S S 3"]], sides: Sequence[int]) -> UInt8[np.ndarray, "N 3"]:
    """Return tiles at every one of the sides, in one row of texels: level by level, in each level tile by tile."""
    levels = [
        np.asarray(Image.fromarray(tile).resize((side, side), Image.Resampling.BOX)).reshape(-1, 3)
        for side in sides
        for tile in tiles
    ]
    return np.concatenate(levels)
