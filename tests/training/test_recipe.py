import dataclasses
import json
from functools import partial
from pathlib import Path

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.shared.training_runs import RECIPE
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.heads.dpt_head import DENSE_HEADS
from vggtjax.training.data import make_batch
from vggtjax.training.objective import LossWeights, init_probes, objective
from vggtjax.training.recipe import Phase, Recipe, read_recipe
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
