import dataclasses
import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.shared.training_runs import RECIPE
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.heads.dpt_head import DENSE_HEADS
from vggtjax.training.data import make_batch
from vggtjax.training.objective import LossWeights, init_probes, objective
from vggtjax.training.optimiser import make_optimiser as make_typed_optimiser
from vggtjax.training.optimiser import make_schedule
from vggtjax.training.recipe import OptimiserConfig, Phase, Recipe, read_recipe
from vggtjax.training.scenes import SceneConfig, load_textures
from vggtjax.training.state import loss_and_gradient, state_shapes

PHASE = {"steps": 5, "batch": 2, "frames": [2, 4], "height": 28, "width": 42}


def changed(**values) -> str:
    return json.dumps({**json.loads(RECIPE.to_json()), **values})


def test_json_round_trip():
    recipe = dataclasses.replace(RECIPE, losses=LossWeights(depth=0.25), remat=True)
    again = Recipe.from_json(recipe.to_json())
    assert again == recipe
    assert hash(again) == hash(recipe)
    assert isinstance(again.model, VGGTConfig)
    assert isinstance(again.stages[0].frames, tuple)


def test_a_head_of_the_network_without_a_loss_is_not_needed(monkeypatch):
    monkeypatch.setitem(DENSE_HEADS, "sky", DENSE_HEADS["depth"])
    assert Recipe.from_json(RECIPE.to_json()).losses.dense == ("depth", "points")


@given(st.integers(1, 1000))
def test_other_numbers_of_steps_keep_the_shares(steps):
    recipe = RECIPE.with_steps(steps)
    assert recipe.total_steps == steps
    for stage in recipe.stages:
        whole = next(s for s in RECIPE.stages if s.width == stage.width)
        assert abs(stage.steps - steps * whole.steps / 6) < 1
    assert recipe.optimiser.warmup_steps == 2 * steps // 6


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (changed(stages=[PHASE | {"speed": 2}]), r"stages\[0\] has unknown fields \['speed'\]"),
        (changed(stages=[PHASE | {"height": 30}]), "multiples of the model's patch_size 14"),
        (changed(stages=[PHASE | {"pitch": [0, 70]}]), r"stages\[0\]: pitch\[1\] is 70.0; expected a number"),
        (changed(stages=[PHASE | {"suppressed_pairs": [0.5, 0.2]}]), r"suppressed_pairs is \(0.5, 0.2\); expected"),
        (changed(stages=[PHASE | {"sizes": [[28, 42]]}]), r"sizes is .*; expected sizes other than \(28, 42\)"),
        (changed(stages=[PHASE | {"known_cameras": 0.5}]), "a phase has known_cameras and the model, of family vggt"),
        (changed(untrained=["neck"]), r"recipe.untrained has \['neck'\]"),
    ],
)
def test_bad_recipes_are_named(text, says):
    with pytest.raises(InputError, match=says):
        Recipe.from_json(text)


DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("path", sorted(DOCS.glob("*/*.json")), ids=lambda path: path.stem)
def test_recipes_of_the_docs_load(path):
    recipe = read_recipe(path)
    assert Recipe.from_json(recipe.to_json()) == recipe
    for phase, read in zip(json.loads(path.read_text())["stages"], json.loads(recipe.to_json())["stages"], strict=True):
        assert read == read | phase  # later fields have their defaults


ON_A_GPU = read_recipe(DOCS / "recipes" / "gpu.json")


def test_the_recipe_for_a_gpu_fits_the_wheel():
    """The model takes at most 24 MB in bfloat16."""
    state = state_shapes(ON_A_GPU, init_probes(0, ON_A_GPU.model))
    assert 2 * sum(leaf.size for leaf in jax.tree.leaves(state.trained["model"])) < 24e6


@pytest.mark.proof
@pytest.mark.parametrize(
    ("stage", "size"), [(stage, size) for stage in (-1, -2) for size in range(len(ON_A_GPU.stages[stage].all_sizes))]
)
def test_the_recipe_for_a_gpu_takes_a_step(stage, size):
    """Shapes of a step of a phase with the most frames."""
    state, phase = state_shapes(ON_A_GPU, init_probes(0, ON_A_GPU.model)), ON_A_GPU.stages[stage]
    step, textures = partial(loss_and_gradient, recipe=ON_A_GPU, objective=objective), load_textures("training")
    draw = partial(make_batch, textures=textures, phase=phase.of_size(size), frames=max(phase.frames))
    metrics, gradient = jax.eval_shape(step, state.trained, jax.eval_shape(draw, jax.random.key(0)))
    assert metrics["loss"].shape == ()
    assert jax.tree.structure(gradient) == jax.tree.structure(state.ema)


def test_fields_of_a_phase_reach_its_scenes():
    changed = {"pitch": (1, 2), "roll": 3, "field_of_view": (40, 50), "boxes": 6, "ellipsoids": 7, "cylinders": 8}
    scenes = Phase(1, 8, (2,), 28, 42, dynamic=0.5, motion=(0.2, 0.3), **changed).scenes(2)
    assert scenes == SceneConfig(28, 42, 2, 0.5, motion=(0.2, 0.3), **changed)


make_optimiser: Any = make_typed_optimiser  # optax's types know no dictionaries


def recipe_with(**optimiser: Any) -> Recipe:
    plain: dict[str, Any] = {"learning_rate": 0.1, "clip_norm": 1e9}
    plain |= dict.fromkeys(("warmup_steps", "decay_steps", "weight_decay"), 0)
    return dataclasses.replace(RECIPE, optimiser=OptimiserConfig(**(plain | optimiser)))


def rates(config: OptimiserConfig, total_steps: int, updates: Iterable[int]) -> np.ndarray:
    schedule: Any = make_schedule(config, total_steps)
    return np.array([schedule(update) for update in updates])


def first_updates(recipe: Recipe, gradient: Any, params: Any) -> Any:
    """Return the updates of the first step."""
    optimiser = make_optimiser(recipe)
    return jax.jit(lambda g, p: optimiser.update(g, optimiser.init(p), p)[0])(gradient, params)


def tree() -> Any:
    """Kernels of two layers of a block, fused q, k and v, and parameters that are no matrices of a block."""
    draw = np.random.default_rng(0).standard_normal
    block = {
        "attention": {"qkv": {"kernel": draw((2, 8, 24)), "bias": draw((2, 24))}},
        "mlp": {"fc1": {"kernel": draw((2, 8, 32))}},
        "norm1": {"scale": draw((2, 8))},
        "scale1": 0.01 * np.ones((2, 8)),
    }
    model = {
        "aggregator": {"frame_blocks": block, "camera_token": draw((2, 1, 8))},
        "backbone": {"patch_embedding": {"kernel": draw((2, 2, 3, 8))}, "position_embedding": draw((5, 8))},
    }
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), {"model": model})


def test_schedules_by_hand():
    config = OptimiserConfig(learning_rate=1.0, warmup_steps=4, decay_steps=4, final_fraction=0.1)
    expected = [0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0, 0.55, 0.1, 0.1]
    np.testing.assert_allclose(rates(config, 20, (0, 1, 2, 3, 4, 10, 16, 18, 20, 50)), expected, rtol=1e-6)
    cosine = OptimiserConfig(learning_rate=2.0, schedule="cosine", warmup_steps=2, final_fraction=0)
    expected = [2 / 3, 2, 1 + np.cos(np.pi / 10), 1, 0]
    np.testing.assert_allclose(rates(cosine, 12, (0, 2, 3, 7, 12)), expected, rtol=1e-5, atol=1e-7)
    constant = OptimiserConfig(learning_rate=0.5, warmup_steps=0, decay_steps=0)
    np.testing.assert_array_equal(rates(constant, 10, (0, 5, 10)), 0.5)


def test_gradients_are_clipped_together():
    params = {"a": {"bias": jnp.array([3.0])}, "b": {"bias": jnp.array([4.0])}}
    optimiser = make_optimiser(recipe_with(clip_norm=0.5))
    _, state = optimiser.update(params, optimiser.init(params), params)
    moments = optax.tree.get(state, "mu")
    np.testing.assert_allclose([moments["a"]["bias"][0], moments["b"]["bias"][0]], [0.03, 0.04], rtol=1e-5)


@pytest.mark.parametrize("kind", ["adamw", "muon"])
def test_only_kernels_decay(kind):
    params = tree()
    gradient = jax.tree.map(jnp.ones_like, params)
    recipes = [recipe_with(kind=kind, weight_decay=decay) for decay in (0, 0.5)]
    updates, decayed = (first_updates(recipe, gradient, params) for recipe in recipes)

    def check(path, plain, decayed, param):
        expected = plain - 0.1 * 0.5 * param * (path[-1].key == "kernel")
        np.testing.assert_allclose(decayed, expected, rtol=1e-4, atol=1e-6)

    jax.tree_util.tree_map_with_path(check, updates, decayed, params)


@pytest.mark.parametrize("kind", ["adamw", "muon"])
def test_parameters_without_a_gradient_do_not_move(kind):
    params = tree()
    updates = first_updates(recipe_with(kind=kind, weight_decay=0.5), jax.tree.map(jnp.zeros_like, params), params)
    assert all(not np.any(update) for update in jax.tree.leaves(updates))


def test_muon_orthogonalises_every_layer_and_projection():
    params = tree()
    updates = first_updates(recipe_with(kind="muon", learning_rate=1), params, params)
    block = updates["model"]["aggregator"]["frame_blocks"]
    qkv = np.asarray(block["attention"]["qkv"]["kernel"]).reshape(2, 8, 3, 8).swapaxes(1, 2)
    fc1 = np.asarray(block["mlp"]["fc1"]["kernel"])
    for matrices, largest in ((qkv, 8), (fc1, 32)):
        values = np.linalg.svd(matrices, compute_uv=False) / (0.2 * largest**0.5)
        assert values.min() > 0.5
        assert values.max() < 1.3
    # Each layer and projection by itself: the same direction as that of its singular vectors.
    gradient = np.asarray(params["model"]["aggregator"]["frame_blocks"]["attention"]["qkv"]["kernel"])
    u, _, v = np.linalg.svd(gradient[1, :, 8:16])
    cosine = np.sum(-qkv[1, 1] * (u @ v)) / np.linalg.norm(qkv[1, 1]) / np.linalg.norm(u @ v)
    assert cosine > 0.97


def test_muon_leaves_everything_else_to_adam():
    params = tree()
    expected, updates = (first_updates(recipe_with(kind=kind), params, params)["model"] for kind in ("adamw", "muon"))
    for updated in (expected, updates):
        blocks = updated["aggregator"]["frame_blocks"]
        del blocks["attention"]["qkv"]["kernel"], blocks["mlp"]["fc1"]["kernel"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), updates, expected)
