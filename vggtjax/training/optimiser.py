"""The optimiser of a recipe: clipping, AdamW or Muon, weight decay of kernels, learning-rate schedule."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from optax.contrib import MuonDimensionNumbers, scale_by_muon

from vggtjax.network.layers import Params
from vggtjax.training.recipe import OptimiserConfig, Recipe

_MUON_DECAY = 0.95  # of its momentum
_ADAM_RMS = 0.2  # root mean square of Adam's updates and of the scaled Muon updates (arXiv 2502.16982, section 2.2)


def make_optimiser(recipe: Recipe) -> optax.GradientTransformation:
    """Return the optimiser of a recipe; its updates are added to the parameters.

    "adamw" is AdamW. "muon" gives the kernels of the transformer blocks, which are stacked on axis 0, the
    orthogonalised momentum of Muon instead of Adam's direction, each layer and each of q, k and v separately, scaled to
    the size of Adam's updates so that one learning rate fits both; every other parameter keeps AdamW.

    Only kernels with a gradient decay: no biases, norms, LayerScales, tokens or position embeddings, and no kernels of
    a head without a loss.
    """
    config = recipe.optimiser
    direction = optax.scale_by_adam(config.b1, config.b2)
    if config.kind == "muon":
        direction = _per_projection(optax.partition({"matrix": _muon(), "other": direction}, _kinds))
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        direction,
        _decay_kernels(config.weight_decay),
        optax.scale_by_learning_rate(make_schedule(config, recipe.total_steps)),
    )


def make_schedule(config: OptimiserConfig, total_steps: int) -> optax.Schedule:
    """Return the learning rate as a function of the number of updates so far."""
    peak, warmup = config.learning_rate, config.warmup_steps
    decay = config.decay_steps if config.schedule == "stable" else total_steps - warmup
    pieces = [
        # The first update has a learning rate above zero.
        optax.linear_schedule(peak / (warmup + 1), peak, warmup) if warmup else optax.constant_schedule(peak),
        optax.constant_schedule(peak),
        optax.cosine_decay_schedule(peak, decay, config.final_fraction) if decay else optax.constant_schedule(peak),
    ]
    return optax.join_schedules(pieces, [warmup, total_steps - decay])


def split(trained: Params, recipe: Recipe) -> tuple[Params, Params]:
    """Return the optimised parameters, and the frozen modules of the model."""
    model = trained["model"]
    moving = {name: module for name, module in model.items() if name not in recipe.frozen}
    return {**trained, "model": moving}, {name: model[name] for name in recipe.frozen}


def join(moving: Params, frozen: Params) -> Params:
    """Return the parameters that `split` separated."""
    return {**moving, "model": {**moving["model"], **frozen}}


def decays(path: tuple[Any, ...]) -> bool:
    """Return whether the parameter at a path of the tree decays: kernels do."""
    return path[-1].key == "kernel"


def _decay_kernels(weight_decay: float) -> optax.GradientTransformation:
    def decayed(path, update, param):
        # The direction is exactly 0 without any gradient so far.
        return update + weight_decay * jnp.where(update == 0, 0, param) if decays(path) else update

    return optax.stateless(partial(jax.tree.map_with_path, decayed))


def _muon() -> optax.GradientTransformation:
    def dimensions(tree: Any) -> Any:
        # All other axes (layers; q, k, v) are batch axes.
        return jax.tree.map(lambda leaf: MuonDimensionNumbers(_input_axis(leaf), leaf.ndim - 1), tree)

    def sized(update, _):
        largest = max(update.shape[_input_axis(update)], update.shape[-1])
        return _ADAM_RMS * largest**0.5 * update  # an orthogonal matrix has a mean square of 1 / its larger side

    direction = scale_by_muon(beta=_MUON_DECAY, weight_dimension_numbers=dimensions)
    return optax.chain(direction, optax.stateless_with_tree_map(sized))


def _input_axis(kernel: jax.Array) -> int:
    """Return the axis of inputs of a stacked kernel: [layer, in, out], or [layer, in, 3, out] of q, k and v."""
    return kernel.ndim - 2 if kernel.ndim == 3 else kernel.ndim - 3


def _is_matrix(path: tuple[Any, ...], leaf: jax.Array) -> bool:
    stacked = any(entry.key.endswith("blocks") or entry.key == "trunk" for entry in path)
    return stacked and path[-1].key == "kernel"


def _kinds(tree: Any) -> Any:
    return jax.tree_util.tree_map_with_path(lambda path, leaf: "matrix" if _is_matrix(path, leaf) else "other", tree)


def _per_projection(inner: optax.GradientTransformation) -> optax.GradientTransformation:
    """Reshape the fused q, k, v kernels [layer, in, 3 out] to [layer, in, 3, out] for `inner`."""

    def apart(tree: Any) -> Any:
        def one(path, leaf):
            fused = _is_matrix(path, leaf) and path[-2].key == "qkv"
            return leaf.reshape(*leaf.shape[:-1], 3, leaf.shape[-1] // 3) if fused else leaf

        return jax.tree_util.tree_map_with_path(one, tree)

    def update(updates: Any, state: Any, params: Any = None):
        separate, state = inner.update(apart(updates), state, None if params is None else apart(params))
        return jax.tree.map(lambda new, old: new.reshape(old.shape), separate, updates), state

    return optax.GradientTransformation(lambda params: inner.init(apart(params)), update)
