"""The parameters that a training run starts from."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Array

from vggtjax.checkpoint import Model
from vggtjax.errors import CheckpointError, InputError
from vggtjax.network.backbone import patch_positions
from vggtjax.network.layers import Params
from vggtjax.network.model import init_params
from vggtjax.training.recipe import Recipe

_SCALES = ("scale1", "scale2")  # LayerScale of a block


def start_params(recipe: Recipe) -> Params:
    """Return the random parameters that a recipe starts from, by its `seed` and its `start`.

    Raises InputError if the recipe has new pairs of a model to start from.
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

    The table of positions is resized as the backbone resizes the table for images of another size.

    Raises CheckpointError if the recipe's model differs in anything else, and as `deepened`.
    """
    config, model = recipe.model, deepened(model, recipe.start.new_pairs)
    names = [field.name for field in dataclasses.fields(config) if field.name not in ("image_size", "motion")]
    if other := [name for name in names if getattr(model.config, name) != getattr(config, name)]:
        values = ", ".join(f"{name} {getattr(model.config, name)}, not {getattr(config, name)}" for name in other)
        raise CheckpointError(
            f"the model '{model.name}' cannot start this recipe: it has {values}; use these values in the recipe's "
            "model, or start from another model"
        )
    backbone, side = model.params["backbone"], config.grid_size
    table = backbone["position_embedding"].astype(jnp.float32)
    patches = patch_positions(table[1:], model.config.grid_size, (side, side))
    return {**model.params, "backbone": {**backbone, "position_embedding": jnp.concatenate([table[:1], patches])}}


def deepened(model: Model, new_pairs: tuple[int, ...]) -> Model:
    """Return a model with new pairs of blocks at these indices; it computes the same.

    A new pair is a copy of the next pair of the model, with a LayerScale of 0. Motion cues stay as they are.

    Raises CheckpointError for an index that appears twice, or that is not below the last pair, which stays the last.
    """
    depth = model.config.depth + len(new_pairs)
    kept = [pair for pair in range(depth) if pair not in new_pairs]
    if len(kept) != model.config.depth or kept[-1] != depth - 1:
        raise CheckpointError(
            f"start.new_pairs is {new_pairs}; expected different indices below {depth - 1}, which is the last pair of "
            f"the deeper model: the model '{model.name}' has {model.config.depth}"
        )
    sources, is_new = np.searchsorted(kept, np.arange(depth)), np.isin(np.arange(depth), new_pairs)

    def deeper(path: tuple[str, ...], leaf: Array) -> Array:
        if path[0] != "aggregator" or path[1] not in ("frame_blocks", "global_blocks"):
            return leaf
        return jnp.where(is_new[:, None], 0, leaf[sources]) if path[-1] in _SCALES else leaf[sources]

    flat: dict[Any, Any] = flatten_dict(model.params)
    params = unflatten_dict({path: deeper(path, leaf) for path, leaf in flat.items()})
    taps = tuple(kept[tap] for tap in model.config.taps)
    return dataclasses.replace(model, params=params, config=dataclasses.replace(model.config, depth=depth, taps=taps))
