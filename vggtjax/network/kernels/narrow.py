"""Weights in the type of the products: half the memory where blocks are computed in bfloat16, with the same numbers."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from vggtjax.network.kernels.quantised import BLOCKS
from vggtjax.network.layers import Params

_LAYERS = ("attention.qkv.", "attention.projection.", "mlp.fc1.", "mlp.fc2.")


def is_multiplied(name: str) -> bool:
    """Return whether the parameter of this dotted name is a kernel or bias that a block turns into its products' type.

    Norms are computed in float32, and so are the heads but for the blocks of the camera head.
    """
    return name.startswith(BLOCKS) and any(layer in name for layer in _LAYERS)


def narrowed(params: Params, compute_dtype: str) -> Params:
    """Return parameters with kernels and biases of the blocks in the type of their products, if it is narrower.

    Results are equal. Kernels in 8 bits stay as they are. Works on shapes too, under `jax.eval_shape`.
    """
    dtype = jnp.dtype(compute_dtype)

    def narrow(name: str, leaf: jax.Array) -> jax.Array:
        is_wider = isinstance(leaf, jax.Array) and leaf.dtype.itemsize > dtype.itemsize
        return leaf.astype(dtype) if is_wider and is_multiplied(name) else leaf

    flat: dict[str, Any] = flatten_dict(params, sep=".")
    return unflatten_dict({name: narrow(name, leaf) for name, leaf in flat.items()}, sep=".")
