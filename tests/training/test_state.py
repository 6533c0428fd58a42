import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.training_runs import RECIPE, SHORT, TASK, init_probes, make_batch, objective, train_step
from vggtjax.checkpoint import read_model, save_model
from vggtjax.config import VGGTConfig
from vggtjax.errors import CheckpointError
from vggtjax.network.model import init_params
from vggtjax.scenes import load_textures
from vggtjax.training.data import make_batch as scenes_batch
from vggtjax.training.objective import LossWeights
from vggtjax.training.objective import init_probes as scenes_probes
from vggtjax.training.objective import objective as scenes_objective
from vggtjax.training.recipe import OptimiserConfig, Phase, Recipe
from vggtjax.training.state import TrainingState, compute_dtype, exported, initial_state, state_shapes


@pytest.fixture(scope="module")
def textures():
    return load_textures("training")


@pytest.fixture(scope="module")
def step():
    return jax.jit(train_step, static_argnums=(2, 3))


@pytest.fixture(scope="module")
def start():
    return initial_state(SHORT, init_probes(0, SHORT.model))


@pytest.fixture(scope="module")
def batch():
    return make_batch(jax.random.key(0), TASK.textures, SHORT.stages[0], 2)


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_a_step_moves_heads_and_probes_alone(step, start, batch):
    state, metrics = step(start, batch, SHORT, objective)
    assert int(state.step) == 1
    assert int(state.skipped) == 0
    for name, module in state.trained["model"].items():
        assert same(module, start.trained["model"][name]) == (name != "camera_head")
    assert not same(state.trained["probes"], start.trained["probes"])
    assert set(state.ema["model"]) == {"camera_head"}
    assert set(metrics) == {"colour_loss", "pose_loss", "loss", "grad_norm", "learning_rate", "skipped"}
    assert all(value.dtype == jnp.float32 for value in metrics.values())
    np.testing.assert_allclose(metrics["learning_rate"], 1e-2 / 3, rtol=1e-6)  # first of two steps of warm-up


def test_loss_falls(step, start, batch):
    state, losses = start, []
    for _ in range(20):
        state, metrics = step(state, batch, SHORT, objective)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.8 * losses[0]


def test_average_leaves_its_start_behind_early(step, start, batch):
    state, expected = start, np.asarray(start.trained["probes"]["mean"]["kernel"])
    for done in range(3):
        state, _ = step(state, batch, SHORT, objective)
        decay = (1 + done) / (10 + done)  # 0.1, 2/11, 3/12: below ema_decay
        expected = decay * expected + (1 - decay) * np.asarray(state.trained["probes"]["mean"]["kernel"])
    np.testing.assert_allclose(state.ema["probes"]["mean"]["kernel"], expected, rtol=1e-5)


def test_averaged_model_is_exported(step, start, batch):
    state, _ = step(start, batch, SHORT, objective)
    params = exported(state, SHORT)
    assert same(params["camera_head"], state.ema["model"]["camera_head"])
    assert same(params["backbone"], start.trained["model"]["backbone"])
    assert set(params) == set(start.trained["model"])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_steps_that_are_not_finite_change_nothing(step, start, batch, bad):
    before, _ = step(start, batch, SHORT, objective)
    after, metrics = step(before, batch * bad, SHORT, objective)
    assert same(after[1:4], before[1:4])
    assert (int(after.step), int(after.skipped)) == (2, 1)
    assert float(metrics["skipped"]) == 1
    again, metrics = step(after, batch, SHORT, objective)
    assert int(again.skipped) == 1
    # The schedule counts updates: this is the second one.
    np.testing.assert_allclose(metrics["learning_rate"], 2e-2 / 3, rtol=1e-6)
    straight, _ = step(before, batch, SHORT, objective)
    assert same(again.trained, straight.trained)


def test_start_from_a_saved_model(tmp_path, step, batch):
    """Fine-tuning: the weights come from a file, the first step begins at them, and the file stays as it is."""
    params = init_params(5, RECIPE.model)
    path = save_model(tmp_path / "model.safetensors", params, RECIPE.model)
    model = read_model(path)
    start = initial_state(SHORT, init_probes(0, SHORT.model), model.params)
    assert same(start.trained["model"], params)
    _, metrics = step(start, batch, SHORT, objective)
    expected, _ = objective(
        {"model": params, "probes": init_probes(0, SHORT.model)},
        batch,
        SHORT.model,
        SHORT.losses,
        compute_dtype="float32",
        remat=False,
    )
    np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-6)
    assert same(model.params, params)


def test_bfloat16_weights_are_trained_in_float32():
    params = jax.tree.map(lambda leaf: np.asarray(leaf).astype(jnp.bfloat16), init_params(0, RECIPE.model))
    state = jax.eval_shape(lambda params: initial_state(SHORT, init_probes(0, SHORT.model), params), params)
    assert {leaf.dtype for leaf in jax.tree.leaves(state.trained)} == {np.dtype(np.float32)}


def test_weights_of_another_model_are_refused():
    params = init_params(0, dataclasses.replace(RECIPE.model, embed_dim=32))
    with pytest.raises(CheckpointError, match=r"do not fit the recipe's model: .* problems: .*mis-shaped parameter"):
        initial_state(SHORT, init_probes(0, SHORT.model), params)
    del params["camera_head"]
    with pytest.raises(CheckpointError, match=r"missing parameter camera_head"):
        initial_state(SHORT, init_probes(0, SHORT.model), params)


@pytest.mark.parametrize(
    ("trainable", "kind"), [("heads", "adamw"), pytest.param("all", "muon", marks=pytest.mark.proof)]
)
def test_shapes_of_the_full_model(textures, trainable, kind):
    """A step of VGGT-1B on generated clips, without its arrays."""
    stages = (Phase(5000, 1, (2,), 518, 518),)
    recipe = Recipe("full", stages, VGGTConfig(), OptimiserConfig(kind=kind), trainable=trainable, remat=True)
    state = state_shapes(recipe, scenes_probes(0, recipe.model))
    batch = jax.eval_shape(lambda key: scenes_batch(key, textures, stages[0], 2), jax.random.key(0))
    found, metrics = jax.eval_shape(
        lambda state, batch: train_step(state, batch, recipe, scenes_objective), state, batch
    )
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), found) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    assert metrics["loss"].shape == ()
    sizes = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in state._asdict().items()}
    assert 1.1e9 < sizes["trained"] < 1.4e9
    if trainable == "heads":  # two moments of the heads alone
        assert sizes["optimiser"] < 0.7e9
        assert set(state.ema["model"]) == {"camera_head", "depth_head", "point_head"}


def test_fine_tuning_on_generated_clips(tmp_path, textures):
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
    batch = jax.jit(scenes_batch, static_argnums=(2, 3))(jax.random.key(1), textures, recipe.stages[0], 3)
    step = jax.jit(train_step, static_argnums=(2, 3))
    losses = []
    for _ in range(5):
        state, metrics = step(state, batch, recipe, scenes_objective)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < losses[0]
    assert same(state.trained["model"]["aggregator"], params["aggregator"])


def test_compute_dtype_follows_the_device():
    expected = "bfloat16" if jax.default_backend() == "gpu" else "float32"
    assert compute_dtype(RECIPE) == expected
    assert compute_dtype(dataclasses.replace(RECIPE, compute_dtype="bfloat16")) == "bfloat16"


def test_state_is_a_tree_of_arrays(start):
    assert isinstance(start, TrainingState)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(start))
