"""Where training starts, what a step changes, and checkpoints, whole, damaged and of other recipes."""

import asyncio
import dataclasses
import json
import os
import shutil
from contextlib import closing
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.tiny import tiny_model
from tests.shared.training_runs import CONFIG, RECIPE, SHORT, TASK, init_probes, make_batch, objective, same, train_step
from vggtjax.config import MotionConfig
from vggtjax.errors import CheckpointError, InputError
from vggtjax.network.backbone import encode
from vggtjax.network.checkpoint import read_model, save_model
from vggtjax.network.model import forward, init_params
from vggtjax.pipeline.pretrained.embedded import demo_model
from vggtjax.training.checkpoints import _explaining, latest, restore, save
from vggtjax.training.data import make_batch as scenes_batch
from vggtjax.training.objective import LossWeights
from vggtjax.training.objective import init_probes as scenes_probes
from vggtjax.training.objective import objective as scenes_objective
from vggtjax.training.recipe import OptimiserConfig, Phase, Recipe, Start, read_recipe
from vggtjax.training.scenes import load_textures
from vggtjax.training.start import adapted, start_params
from vggtjax.training.state import initial_state, state_shapes


@pytest.fixture(scope="module")
def start():
    return initial_state(SHORT, init_probes(0, SHORT.model))


@pytest.fixture(scope="module")
def batch():
    return make_batch(jax.random.key(0), TASK.textures, SHORT.stages[0], 2, CONFIG.patch_size)


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


def with_model(recipe: Recipe, **changes) -> Recipe:
    """Return the recipe with another model."""
    return dataclasses.replace(recipe, model=dataclasses.replace(recipe.model, **changes))


def test_tied_keys_and_layer_scale():
    recipe = dataclasses.replace(RECIPE, start=Start(layer_scale=0.3, tied_keys=True))
    params = start_params(recipe)["aggregator"]
    for blocks, tied in (("global_blocks", True), ("frame_blocks", False)):
        query, key, value = np.split(np.asarray(params[blocks]["attention"]["qkv"]["kernel"]), 3, axis=-1)
        assert np.array_equal(query, key) == tied
        assert not np.array_equal(query, value)
        assert np.allclose(params[blocks]["scale1"], 0.3)
    assert Recipe.from_json(recipe.to_json()) == recipe


def test_the_embedded_model_starts_a_recipe_with_another_image_size_and_other_cues():
    recipe = read_recipe(Path(__file__).parents[2] / "docs" / "embedded" / "11-twelve-pairs.json")
    model = demo_model()
    recipe = dataclasses.replace(with_model(recipe, image_size=112, motion=MotionConfig()), start=Start())
    params = adapted(model, recipe)
    jax.eval_shape(lambda params: initial_state(recipe, init_probes(0, recipe.model), params), params)
    same = adapted(model, with_model(recipe, image_size=model.config.image_size))
    assert jax.tree.all(jax.tree.map(np.array_equal, same, model.params))
    images = jnp.asarray(np.random.default_rng(0).uniform(size=(1, 1, 112, 112, 3)), jnp.float32)
    run = jax.jit(encode, static_argnames="config")
    models = ((model.params, model.config), (params, recipe.model))
    tokens = [run(weights, images, config).patch_tokens for weights, config in models]
    np.testing.assert_allclose(tokens[0], tokens[1], atol=1e-5)  # the backbone resizes the table alike
    with pytest.raises(CheckpointError, match="it has embed_dim 128, not 256, num_heads 4, not 8; use these values in"):
        adapted(model, with_model(recipe, embed_dim=256, num_heads=8))


def test_a_deeper_model_computes_the_same_and_its_new_pairs_count():
    shallow, new = tiny_model(), (0, 2)
    model = dataclasses.replace(shallow.config, depth=6, taps=(1, 3, 4, 5))
    recipe = dataclasses.replace(RECIPE, model=model, start=Start(new_pairs=new))
    assert recipe.initial_model == shallow.config
    params = adapted(shallow, recipe)
    images = jnp.asarray(np.random.default_rng(0).uniform(size=(1, 2, 28, 28, 3)), jnp.float32)

    @partial(jax.jit, static_argnames="config")
    def poses(params, config):
        return jnp.asarray(forward(params, images, config, outputs=("camera",)).pose_encoding)

    same = poses(shallow.params, shallow.config)
    np.testing.assert_array_equal(poses(params, model), same)
    for blocks in ("frame_blocks", "global_blocks"):  # any step away from a LayerScale of 0 is seen
        for pair in new:
            scale = params["aggregator"][blocks]["scale1"]
            louder = params["aggregator"][blocks] | {"scale1": scale.at[pair].set(1.0)}
            changed = params | {"aggregator": params["aggregator"] | {blocks: louder}}
            assert np.abs(poses(changed, model) - same).max() > 1e-6
    with pytest.raises(CheckpointError, match=r"it has depth 4, not 5, .*model \(without its start.new_pairs \(0,\)\)"):
        adapted(shallow, dataclasses.replace(recipe, start=Start(new_pairs=(0,))))


def test_starts_that_cannot_be_are_refused():
    recipe = with_model(RECIPE, depth=6, taps=(0, 2, 3, 5))
    for new in ((1, 1), (5,), (3,)):
        with pytest.raises(InputError, match="expected different indices below 5, the last pair of a model of depth 6"):
            dataclasses.replace(recipe, start=Start(new_pairs=new))
    recipe = with_model(RECIPE, depth=6, taps=(1, 3, 4, 5))
    with pytest.raises(InputError, match=r"start\.new_pairs is \(0,\) and no model to start from is given"):
        start_params(dataclasses.replace(recipe, start=Start(new_pairs=(0,))))
    with pytest.raises(InputError, match=r"start\.layer_scale is 0"):
        Start(layer_scale=0.0)


@pytest.fixture(scope="module")
def shapes():
    return state_shapes(SHORT, init_probes(0, SHORT.model))


@pytest.fixture(scope="module")
def state(shapes):
    """Nothing is what a fresh state would have."""
    generator = np.random.default_rng(0)

    def other(leaf):
        values = generator.standard_normal(leaf.shape) if leaf.dtype == jnp.float32 else np.full(leaf.shape, 3)
        return jax.device_put(np.asarray(values, leaf.dtype))

    return jax.tree.map(other, shapes)


@pytest.fixture(scope="module")
def saved(tmp_path_factory, state):
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    save(folder, state, SHORT, {"seconds": 0.1 + 0.2})
    return folder


def test_round_trip_is_exact(saved, state, shapes):
    assert latest(saved) == 3
    found = restore(saved, shapes, SHORT)
    assert found.recipe == SHORT
    assert found.notes == {"seconds": 0.1 + 0.2}
    assert jax.tree.structure(found.state) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(found.state), jax.tree.leaves(state), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_the_last_two_are_kept_and_what_an_interrupted_save_left_is_removed(tmp_path, saved, state):
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    shutil.copytree(saved / "3", tmp_path / "9.orbax-checkpoint-tmp")
    assert latest(tmp_path) == 3
    assert (tmp_path / "9.orbax-checkpoint-tmp").exists()  # who reads removes nothing
    save(tmp_path, state._replace(step=jnp.int32(10)), SHORT)
    save(tmp_path, state._replace(step=jnp.int32(12)), SHORT)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["10", "12"]
    assert latest(tmp_path) == 12


def test_folders_without_a_checkpoint(tmp_path, shapes):
    for folder in (tmp_path, tmp_path / "none"):
        assert latest(folder) is None
        with pytest.raises(CheckpointError, match="holds no checkpoint"):
            restore(folder, shapes, SHORT)


def test_checkpoint_of_another_recipe(saved, shapes):
    """It is refused before its state is read, whose shapes would differ."""
    for changes, says in (
        ({"trainable": "all"}, "another trainable"),
        ({"optimiser": OptimiserConfig(kind="muon", warmup_steps=0, decay_steps=0)}, r"another optimiser\.kind"),
    ):
        with pytest.raises(CheckpointError, match=says):
            restore(saved, shapes, dataclasses.replace(SHORT, **changes))


def test_damaged_checkpoints(tmp_path, saved, shapes):
    run = json.loads((saved / "3/run/metadata").read_text())
    for number, (name, content) in enumerate(
        (
            ("run/metadata", b"{"),
            ("run/metadata", json.dumps(run | {"recipe": {"name": "x"}}).encode()),
            ("state/_METADATA", b"\x80\x04K\x01."),  # a pickle
            ("state/manifest.ocdbt", b"\x00" * 99),
            ("state/_METADATA", None),
        )
    ):
        folder = Path(shutil.copytree(saved, tmp_path / f"damaged{number}"))
        if content is None:
            (folder / "3" / name).unlink()
            os.mkfifo(folder / "3" / name)
        else:
            (folder / "3" / name).write_bytes(content)
        says = "is a pipe" if content is None else "cannot be read as a checkpoint|is a checkpoint of|holds the state"
        with pytest.raises(CheckpointError, match=says):
            restore(folder, shapes, SHORT)


def test_where_a_read_fails_the_others_end_before_orbax_closes_their_loop(tmp_path):
    ended = []

    async def slow():
        await asyncio.sleep(0.05)
        ended.append(True)

    async def broken():
        raise ValueError("damaged")

    async def both():
        await asyncio.gather(slow(), broken())

    refused = pytest.raises(CheckpointError, match="damaged")
    with refused, _explaining(tmp_path), closing(asyncio.new_event_loop()) as loop:
        loop.run_until_complete(both())
    assert ended
