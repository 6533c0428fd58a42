"""Weights in the type of the products: half the memory where blocks are computed in bfloat16, with the same numbers."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vggtjax.network.layers import Params

_BLOCKS = {("backbone", "blocks"), ("aggregator", "frame_blocks"), ("aggregator", "global_blocks")}


def narrowed(params: Params, compute_dtype: str) -> Params:
    """Return parameters whose kernels and biases of the blocks have the type in which they are multiplied.

    A block turns them into that type anyway, so results are equal. Norms and heads, which are computed in float32, and
    kernels in 8 bits stay as they are. Works on shapes too, under `jax.eval_shape`.
    """
    dtype = jnp.dtype(compute_dtype)

    def narrow(path: tuple[Any, ...], leaf: Any) -> Any:
        names = tuple(entry.key for entry in path if hasattr(entry, "key"))
        is_product = names[:2] in _BLOCKS and names[-1] in ("kernel", "bias") and "norm" not in names[-2]
        smaller = jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype.itemsize > dtype.itemsize
        return leaf.astype(dtype) if is_product and smaller and len(names) == len(path) else leaf

    return jax.tree_util.tree_map_with_path(narrow, params)
