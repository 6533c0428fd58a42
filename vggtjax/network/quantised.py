"""Weights in 8 bits: the kernels of the blocks, symmetric, with a scale for every output channel. An approximation.

Products are computed in the blocks' own type: a block's kernels are turned back when it runs, so one layer at a time is
in memory at full width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int8

LARGEST = 127
_BLOCKS = ("backbone.blocks.", "aggregator.frame_blocks.", "aggregator.global_blocks.", "camera_head.trunk.")


class Quantised(NamedTuple):
    """A kernel as `values` times `scale`: each weight is off by at most half of its channel's scale."""

    values: Int8[Array, "*L I O"]
    scale: Float[Array, "*L 1 O"]


def is_quantised(name: str) -> bool:
    """Return whether the parameter of this dotted name is stored in 8 bits: kernels of the blocks, 88 % of VGGT-1B."""
    return name.startswith(_BLOCKS) and name.endswith(".kernel")


def quantise(kernel: Float[np.ndarray, "*L I O"]) -> Quantised:
    """Round a kernel, or one for each layer: the largest weight of an output channel becomes 127 or -127."""
    values, scales = np.empty(kernel.shape, np.int8), np.empty((*kernel.shape[:-2], 1, kernel.shape[-1]), np.float32)
    for layer in np.ndindex(kernel.shape[:-2]):  # one at a time: the file is mapped, and wider copies would not fit
        weights = np.asarray(kernel[layer], np.float32)
        scale = np.abs(weights).max(axis=0, keepdims=True) / np.float32(LARGEST)
        scale[scale == 0] = 1
        values[layer], scales[layer] = np.rint(weights / scale), scale
    return Quantised(jax.device_put(values), jax.device_put(scales))


def dequantised(params: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block's parameters with kernels in float32; others are returned as they are."""

    def widen(leaf: Any) -> Any:
        return leaf.values.astype(leaf.scale.dtype) * leaf.scale if isinstance(leaf, Quantised) else leaf

    return jax.tree.map(widen, dict(params), is_leaf=lambda leaf: isinstance(leaf, Quantised))
