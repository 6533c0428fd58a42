"""Where training from nothing starts: parameters that make correspondence easy to find."""

from __future__ import annotations

import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from vggtjax.config import VGGTConfig
from vggtjax.network.layers import Params
from vggtjax.network.model import init_params


def start_params(seed: int, config: VGGTConfig, layer_scale: float = 0.3, tied_keys: bool = True) -> Params:
    """Return random parameters for a model that learns without a pretrained backbone.

    Args:
        seed: of the random numbers.
        config: the model's configuration.
        layer_scale: start of the aggregator's LayerScale. VGGT's 0.01 suits a backbone that already sees; here it
            would keep attention across frames out of the residual stream for hundreds of steps.
        tied_keys: the global blocks' keys start equal to their queries, so that attention starts as similarity and
            looks for the same thing in other frames from the first step on.
    """
    flat = flatten_dict(init_params(seed, config))
    for path, leaf in flat.items():
        if path[0] == "aggregator" and path[-1] in ("scale1", "scale2"):
            flat[path] = jnp.full_like(leaf, layer_scale)
        if tied_keys and path[:2] == ("aggregator", "global_blocks") and path[-2:] == ("qkv", "kernel"):
            query, _, value = jnp.split(leaf, 3, axis=-1)
            flat[path] = jnp.concatenate([query, query, value], axis=-1)
    return unflatten_dict(flat)
