"""A training run small enough for tests: a tiny model, and an objective that pulls it towards the batch."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from tests.shared.tiny import tiny_config
from vggtjax.config import VGGTConfig
from vggtjax.training import loop
from vggtjax.training.loop import Task
from vggtjax.training.metrics import read_metrics
from vggtjax.training.recipe import OptimiserConfig, Phase, Recipe
from vggtjax.training.run import placement
from vggtjax.training.state import Metrics, TrainingState

CONFIG = tiny_config(image_size=28, dpt_channels=(4, 4, 4, 4))
RECIPE = Recipe(
    name="tiny",
    stages=(Phase(4, 2, (2, 3), 28, 28, sizes=((28, 42),)), Phase(2, 2, (2,), 28, 42)),
    model=CONFIG,
    optimiser=OptimiserConfig(learning_rate=1e-2, warmup_steps=2, decay_steps=2),
    untrained=("track_head", "depth_head", "point_head"),
)
SHORT = dataclasses.replace(RECIPE, trainable="heads")  # fewer parameters, which compile faster
PROBES = dataclasses.replace(SHORT, untrained=(*SHORT.untrained, "camera_head"))  # and none of the model


def init_probes(seed: int, config: VGGTConfig):
    """Return a read-out that says zero."""
    return {"mean": {"kernel": jnp.full((3, 3), 0.1 * (1 + seed)), "bias": jnp.zeros(3)}}


def make_batch(key, textures, phase: Phase, frames: int, patch_size: int):
    """Return noise images."""
    return textures * jax.random.uniform(key, (phase.batch, frames, phase.height, phase.width, 3))


def objective(trained, batch, config, weights, *, compute_dtype, remat):
    """Pull the probes' colour and the camera head's pose to the clips."""
    colour = batch.mean(axis=(1, 2, 3))
    found = colour @ trained["probes"]["mean"]["kernel"] + trained["probes"]["mean"]["bias"][None]
    colour_loss = jnp.mean(jnp.sum((found - colour) ** 2, axis=-1))
    pose = trained["model"]["camera_head"]["pose_branch"]["fc2"]
    distance = pose["kernel"][None] - colour.mean(axis=-1)[:, None, None]
    pose_loss = jnp.mean(distance**2) + jnp.mean(pose["bias"] ** 2)
    loss = weights.translation * colour_loss + weights.rotation * pose_loss
    return loss, {"colour_loss": colour_loss, "pose_loss": pose_loss}


def train_step(state: TrainingState, batch, recipe: Recipe, objective) -> tuple[TrainingState, Metrics]:
    """Do one step of training by the programs of the loop, of which one consumes its state."""
    state, batch = jax.device_put(jax.device_get((state, batch)), placement(recipe).whole)
    metrics, gradient = loop._loss_and_gradient(state.trained, batch, recipe, objective)
    return loop._apply_gradient(state, gradient, metrics, recipe)


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def measured(path):
    """Rows of metrics without what a clock says."""
    return [{k: v for k, v in row.items() if k not in ("seconds", "render_share")} for row in read_metrics(path)]


TASK = Task(jnp.float32(1), make_batch, init_probes, objective)
