"""Where training from nothing starts: parameters that make correspondence easy to find."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from vggtjax.network.layers import Params
from vggtjax.network.model import init_params
from vggtjax.training.recipe import Recipe


def start_params(recipe: Recipe) -> Params:
    """Return the random parameters that a recipe starts from, by its `seed` and its `start`."""
    flat: dict[Any, Any] = flatten_dict(init_params(recipe.seed, recipe.model))
    for path, leaf in flat.items():
        if path[0] == "aggregator" and path[-1] in ("scale1", "scale2"):
            flat[path] = jnp.full_like(leaf, recipe.start.layer_scale)
        if recipe.start.tied_keys and path[:2] == ("aggregator", "global_blocks") and path[-2:] == ("qkv", "kernel"):
            query, _, value = jnp.split(leaf, 3, axis=-1)
            flat[path] = jnp.concatenate([query, query, value], axis=-1)
    return unflatten_dict(flat)
