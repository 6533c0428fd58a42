"""The state of a training run, and one step of it as a pure function."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Float, Int

from vggtjax.network.checkpoint import check_parameters
from vggtjax.network.layers import Params
from vggtjax.network.model import parameter_shapes
from vggtjax.storage.backend import backend
from vggtjax.training.optimiser import join, make_optimiser, make_schedule, split
from vggtjax.training.recipe import Recipe
from vggtjax.training.start import start_params

Objective = Callable[..., tuple[Float[Array, ""], dict[str, Float[Array, ""]]]]
Metrics = dict[str, Float[Array, ""]]


class TrainingState(NamedTuple):
    """The input and output of a step."""

    step: Int[Array, ""]  # steps done
    trained: Params  # {"model": ..., "probes": ...}
    ema: Params  # exponential moving average of the optimised parameters
    optimiser: Any
    skipped: Int[Array, ""]  # steps without effect, as the loss or the gradient was not finite


def initial_state(recipe: Recipe, probes: Params, init: Params | None = None) -> TrainingState:
    """Return the state before the first step, in float32, from the objective's own parameters and the model's.

    Without `init` the model's parameters are random. Raises CheckpointError if `init` does not fit the recipe's model.
    """
    if init is None:
        init = start_params(recipe)
    else:
        subject = "the parameters to start from do not fit the recipe's model"
        check_parameters(subject, flatten_dict(init, sep="."), recipe.model)
    # Copies: a step consumes its state, and the caller keeps the parameters.
    trained = jax.tree.map(lambda leaf: jnp.array(leaf, jnp.float32), {"model": init, "probes": probes})
    moving, _ = split(trained, recipe)
    ema = jax.tree.map(jnp.copy, moving)
    return TrainingState(jnp.int32(0), trained, ema, make_optimiser(recipe).init(moving), jnp.int32(0))


def state_shapes(recipe: Recipe, probes: Params) -> TrainingState:
    """Return shapes and dtypes of a recipe's state without its arrays; reads only the shapes of `probes`."""
    return jax.eval_shape(partial(initial_state, recipe), probes, parameter_shapes(recipe.model))


def loss_and_gradient(trained: Params, batch: Any, recipe: Recipe, objective: Objective) -> tuple[Metrics, Params]:
    """Return the objective's metrics with the loss, and its gradient by the optimised parameters of `trained`.

    Recipe and objective are static under jit; `Task` describes the objective and its batch.
    """
    moving, frozen = split(trained, recipe)

    def loss_of(moving: Params):
        compute = {"compute_dtype": compute_dtype(recipe), "remat": recipe.remat}
        return objective(join(moving, frozen), batch, recipe.model, recipe.losses, **compute)

    (loss, metrics), gradient = jax.value_and_grad(loss_of, has_aux=True)(moving)
    return {**metrics, "loss": loss}, gradient


def apply_gradient(
    state: TrainingState, gradient: Params, metrics: Metrics, recipe: Recipe
) -> tuple[TrainingState, Metrics]:
    """Update the state by a gradient; pure, for `jax.jit` with the state donated.

    A step with a loss or gradient norm that is not finite is skipped: parameters, averages and optimiser stay
    unchanged. The decay of the average is min(ema_decay, (1 + t) / (10 + t)) after t updates, so that the start has
    little weight early.

    `recipe` is static under jit. The returned metrics, in float32, have gained grad_norm (before clipping),
    learning_rate and skipped (1 for a skipped step, else 0).
    """
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(norm)
    moving, frozen = split(state.trained, recipe)
    updates, optimiser_state = make_optimiser(recipe).update(gradient, state.optimiser, moving)
    moved = jax.tree.map(jnp.add, moving, updates)
    done = state.step - state.skipped  # updates before this one
    decay = jnp.minimum(recipe.optimiser.ema_decay, (1 + done) / (10 + done))
    ema = jax.tree.map(lambda average, new: decay * average + (1 - decay) * new, state.ema, moved)
    moved, ema, optimiser_state = jax.tree.map(
        partial(jnp.where, finite), (moved, ema, optimiser_state), (moving, state.ema, state.optimiser)
    )
    skipped = 1 - finite.astype(jnp.int32)
    trained = join(moved, frozen)
    next_state = TrainingState(state.step + 1, trained, ema, optimiser_state, state.skipped + skipped)
    rate = make_schedule(recipe.optimiser, recipe.total_steps)(done)
    logged = {**metrics, "grad_norm": norm, "learning_rate": rate, "skipped": skipped}
    return next_state, {name: jnp.asarray(value, jnp.float32) for name, value in logged.items()}


def exported(state: TrainingState, recipe: Recipe) -> Params:
    """Return the model's averaged parameters."""
    _, frozen = split(state.trained, recipe)
    return join(state.ema, frozen)["model"]


def compute_dtype(recipe: Recipe) -> str:
    """Return the dtype of the blocks' matrix products: "auto" is bfloat16 on a GPU and float32 elsewhere."""
    if recipe.compute_dtype != "auto":
        return recipe.compute_dtype
    return "bfloat16" if backend() == "gpu" else "float32"
