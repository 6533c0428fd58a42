"""The parameters that a training run starts from."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from vggtjax.errors import CheckpointError, InputError
from vggtjax.network.backbone import resized
from vggtjax.network.checkpoint import Model
from vggtjax.network.layers import Params
from vggtjax.network.model import init_params
from vggtjax.training.recipe import Recipe

_SCALES = ("scale1", "scale2")  # LayerScale of a block


def start_params(recipe: Recipe) -> Params:
    """Return the random parameters that a recipe starts from, by its `seed` and its `start`.

    Raises InputError if the recipe has new pairs, which need a model to start from.
    """
    if recipe.start.new_pairs:
        raise InputError(
            f"start.new_pairs is {recipe.start.new_pairs} and no model to start from is given; expected (), or a model "
            "(--init)"
        )
    flat: dict[Any, Any] = flatten_dict(init_params(recipe.seed, recipe.model))
    for path, leaf in flat.items():
        if path[0] == "aggregator" and path[-1] in _SCALES:
            flat[path] = jnp.full_like(leaf, recipe.start.layer_scale)
        if recipe.start.tied_keys and path[:2] == ("aggregator", "global_blocks") and path[-2:] == ("qkv", "kernel"):
            query, _, value = jnp.split(leaf, 3, axis=-1)
            flat[path] = jnp.concatenate([query, query, value], axis=-1)
    return unflatten_dict(flat)


def adapted(model: Model, recipe: Recipe) -> Params:
    """Return a model's parameters for a recipe with another image size, other motion cues, or new pairs of blocks.

    The table of positions is resized (`resized`).

    Raises CheckpointError if the model differs from the recipe's in anything else.
    """
    config = recipe.initial_model
    names = [field.name for field in dataclasses.fields(config) if field.name not in ("image_size", "motion")]
    if other := [name for name in names if getattr(model.config, name) != getattr(config, name)]:
        values = ", ".join(f"{name} {getattr(model.config, name)}, not {getattr(config, name)}" for name in other)
        without = f" (without its start.new_pairs {recipe.start.new_pairs})" if recipe.start.new_pairs else ""
        raise CheckpointError(
            f"the model '{model.name}' cannot start this recipe: it has {values}; use these values in the recipe's "
            f"model{without}, or start from another model"
        )
    params = {**model.params, "backbone": resized(model.params["backbone"], model.config, config.grid_size)}
    return deepened(params, recipe) if recipe.start.new_pairs else params


def deepened(params: Params, recipe: Recipe) -> Params:
    """Return the parameters of `recipe.initial_model` with the recipe's new pairs of blocks.

    A new pair is a copy of the next old one, with a LayerScale of 0: a plain pass computes the same as before.
    """
    pairs = np.arange(recipe.model.depth)
    is_new = np.isin(pairs, recipe.start.new_pairs)
    sources = np.searchsorted(pairs[~is_new], pairs)
    flat: dict[Any, Any] = flatten_dict(params)
    for path, leaf in flat.items():
        if path[:2] in (("aggregator", "frame_blocks"), ("aggregator", "global_blocks")):
            deeper = jnp.asarray(leaf)[sources]
            flat[path] = jnp.where(is_new[:, None], 0, deeper) if path[-1] in _SCALES else deeper
    return unflatten_dict(flat)
