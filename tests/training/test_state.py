import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.training_runs import RECIPE, SHORT, TASK, init_probes, make_batch, objective, same, train_step
from vggtjax.errors import CheckpointError
from vggtjax.network.checkpoint import read_model, save_model
from vggtjax.network.model import init_params
from vggtjax.training.data import make_batch as scenes_batch
from vggtjax.training.objective import LossWeights
from vggtjax.training.objective import init_probes as scenes_probes
from vggtjax.training.objective import objective as scenes_objective
from vggtjax.training.recipe import OptimiserConfig, Phase
from vggtjax.training.scenes import load_textures
from vggtjax.training.state import initial_state


@pytest.fixture(scope="module")
def start():
    return initial_state(SHORT, init_probes(0, SHORT.model))


@pytest.fixture(scope="module")
def batch():
    return make_batch(jax.random.key(0), TASK.textures, SHORT.stages[0], 2)


def test_a_step_moves_heads_and_probes_alone(start, batch):
    state, metrics = train_step(start, batch, SHORT, objective)
    assert int(state.step) == 1
    assert int(state.skipped) == 0
    for name, module in state.trained["model"].items():
        assert same(module, start.trained["model"][name]) == (name != "camera_head")
    assert not same(state.trained["probes"], start.trained["probes"])
    assert set(state.ema["model"]) == {"camera_head"}
    assert set(metrics) == {"colour_loss", "pose_loss", "loss", "grad_norm", "learning_rate", "skipped"}
    assert all(value.dtype == jnp.float32 for value in metrics.values())
    np.testing.assert_allclose(metrics["learning_rate"], 1e-2 / 3, rtol=1e-6)  # first of two steps of warm-up


def test_average_leaves_its_start_behind_early(start, batch):
    state, expected = start, np.asarray(start.trained["probes"]["mean"]["kernel"])
    for done in range(3):
        state, _ = train_step(state, batch, SHORT, objective)
        decay = (1 + done) / (10 + done)  # 0.1, 2/11, 3/12: below ema_decay
        expected = decay * expected + (1 - decay) * np.asarray(state.trained["probes"]["mean"]["kernel"])
    np.testing.assert_allclose(state.ema["probes"]["mean"]["kernel"], expected, rtol=1e-5)


def test_steps_that_are_not_finite_change_nothing(start, batch):
    before, _ = train_step(start, batch, SHORT, objective)
    after, metrics = train_step(before, batch * np.nan, SHORT, objective)
    assert same(after[1:4], before[1:4])
    assert (int(after.step), int(after.skipped)) == (2, 1)
    again, metrics = train_step(after, batch, SHORT, objective)
    # The schedule counts updates: this is the second one.
    np.testing.assert_allclose(metrics["learning_rate"], 2e-2 / 3, rtol=1e-6)
    straight, _ = train_step(before, batch, SHORT, objective)
    assert same(again.trained, straight.trained)


def test_weights_of_another_model_are_refused():
    params = init_params(0, dataclasses.replace(RECIPE.model, embed_dim=32))
    with pytest.raises(CheckpointError, match=r"do not fit the recipe's model: .* problems: .*mis-shaped parameter"):
        initial_state(SHORT, init_probes(0, SHORT.model), params)
    del params["camera_head"]
    with pytest.raises(CheckpointError, match=r"missing parameter camera_head"):
        initial_state(SHORT, init_probes(0, SHORT.model), params)


@pytest.mark.proof
def test_fine_tuning_on_generated_clips(tmp_path):
    """The camera head of a saved model takes steps that lower the real objective on one batch of clips."""
    recipe = dataclasses.replace(
        SHORT,
        stages=(Phase(20, 2, (3,), 28, 28),),
        losses=LossWeights(depth=0, points=0),
        optimiser=OptimiserConfig(learning_rate=1e-3, warmup_steps=0, decay_steps=0),
    )
    params = init_params(5, recipe.model)
    path = save_model(tmp_path / "model.safetensors", params, recipe.model)
    state = initial_state(recipe, scenes_probes(0, recipe.model), read_model(path).params)
    assert same(state.trained["model"], params)
    draw = jax.jit(scenes_batch, static_argnums=(2, 3))
    batch = draw(jax.random.key(1), load_textures("training"), recipe.stages[0], 3)
    losses = []
    for _ in range(5):
        state, metrics = train_step(state, batch, recipe, scenes_objective)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < losses[0]
    assert same(state.trained["model"]["aggregator"], params["aggregator"])
