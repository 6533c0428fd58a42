"""Kernels that are stored in another form than they are multiplied in: in 8 bits, or as the bits of bfloat16.

A block's kernels are turned back when it runs, so one layer at a time is in memory in that form.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int8, UInt16

LARGEST = 127
BLOCKS = (  # whose kernels can be kept in another form
    "backbone.blocks.",
    "aggregator.leading_block.",
    "aggregator.frame_blocks.",
    "aggregator.global_blocks.",
    "camera_head.trunk.",
    "camera_encoder.trunk.",
)


class Halves(NamedTuple):
    """A kernel of bfloat16 as whole numbers: in a loop over layers XLA for CPUs widens stacks of bfloat16, whole."""

    bits: UInt16[Array, "*L I O"]


class Quantised(NamedTuple):
    """A kernel in 8 bits, an approximation: symmetric, with a scale for every output channel.

    It is `values` times `scale`: each weight is off by at most half of its channel's scale."""

    values: Int8[Array, "*L I O"]
    scale: Float[Array, "*L 1 O"]


def is_quantised(name: str) -> bool:
    """Return whether the parameter of this dotted name is stored in 8 bits: kernels of the blocks, 88 % of VGGT-1B."""
    return name.startswith(BLOCKS) and name.endswith(".kernel")


def quantise(kernel: Float[np.ndarray, "*L I O"]) -> Quantised:
    """Round a kernel, or one for each layer: the largest weight of an output channel becomes 127 or -127."""
    values, scales = np.empty(kernel.shape, np.int8), np.empty((*kernel.shape[:-2], 1, kernel.shape[-1]), np.float32)
    for layer in np.ndindex(kernel.shape[:-2]):  # one at a time: the file is mapped, and wider copies would not fit
        weights = np.asarray(kernel[layer], np.float32)
        scale = np.abs(weights).max(axis=0, keepdims=True) / np.float32(LARGEST)
        scale[scale == 0] = 1
        values[layer], scales[layer] = np.rint(weights / scale), scale
    return Quantised(jax.device_put(values), jax.device_put(scales))


def halves(kernel: np.ndarray) -> Halves:
    """Store a kernel of bfloat16."""
    return Halves(jax.device_put(kernel.view(np.uint16)))


def is_stored(leaf: Any) -> bool:
    """Return whether a parameter is a kernel in another form."""
    return isinstance(leaf, Quantised | Halves)


def as_multiplied(params: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block's parameters with kernels of 8 bits in float32, halves in bfloat16, and others as they are."""

    def turned(leaf: Any) -> Any:
        if isinstance(leaf, Quantised):
            return leaf.values.astype(leaf.scale.dtype) * leaf.scale
        return jax.lax.bitcast_convert_type(leaf.bits, jnp.bfloat16) if isinstance(leaf, Halves) else leaf

    return jax.tree.map(turned, dict(params), is_leaf=is_stored)
