"""Which pixels become points. Does not import jax."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int


def inside_box(box: Int[np.ndarray, "*F 4"], size: tuple[int, ...]) -> Bool[np.ndarray, "*F H W"]:
    """Return the pixels of a picture of this height and width that lie in a box of left, top, right, bottom."""
    rows, columns = np.arange(size[0])[:, None], np.arange(size[1])
    left, top, right, bottom = np.moveaxis(box, -1, 0)[..., None, None]
    return (left <= columns) & (columns < right) & (top <= rows) & (rows < bottom)


def show_points(
    depth: Float32[np.ndarray, "*F H W"], confidence: Float32[np.ndarray, "*F H W"], seen: Bool[np.ndarray, "*F H W"]
) -> Bool[np.ndarray, "*F H W"]:
    """Return the seen pixels with a finite depth above 0 and a finite confidence."""
    return seen & np.isfinite(depth) & (depth > 0) & np.isfinite(confidence)
