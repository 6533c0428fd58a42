import dataclasses
import json
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.training_runs import RECIPE
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.scenes import SceneConfig, load_textures
from vggtjax.training.data import make_batch
from vggtjax.training.objective import LossWeights, init_probes, objective
from vggtjax.training.recipe import OptimiserConfig, Phase, Recipe, read_recipe
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


def test_only_name_and_stages_are_required():
    values = {"name": "short", "stages": [PHASE], "optimiser": {"warmup_steps": 1, "decay_steps": 2}}
    recipe = Recipe.from_json(json.dumps(values))
    assert recipe.model == VGGTConfig()
    assert recipe.stages == (Phase(5, 2, (2, 4), 28, 42),)
    assert recipe.optimiser == OptimiserConfig(warmup_steps=1, decay_steps=2)


def test_phases_follow_each_other():
    assert RECIPE.total_steps == 6
    assert [RECIPE.phase_at(step)[0] for step in range(8)] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert RECIPE.phase_at(4)[1] is RECIPE.stages[1]


def test_frozen_modules():
    assert RECIPE.frozen == ("track_head", "depth_head", "point_head")
    heads = dataclasses.replace(RECIPE, trainable="heads", untrained=("track_head",))
    assert heads.frozen == ("backbone", "aggregator", "track_head")


@given(st.integers(1, 1000))
def test_other_numbers_of_steps_keep_the_shares(steps):
    recipe = RECIPE.with_steps(steps)
    assert recipe.total_steps == steps
    for stage in recipe.stages:
        whole = next(s for s in RECIPE.stages if s.width == stage.width)
        assert abs(stage.steps - steps * whole.steps / 6) < 1
    assert recipe.optimiser.warmup_steps == 2 * steps // 6


def test_whole_numbers_become_floats():
    assert type(OptimiserConfig(learning_rate=1).learning_rate) is float


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "is not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[]", "expected an object"),
        (json.dumps({"name": "x"}), "lacks the field 'stages'"),
        (changed(colour=1), r"unknown fields \['colour'\]"),
        (changed(stages=[]), r"stages is \[\]; expected a list of at least 1 values"),
        (changed(stages=[[[[]]]]), r"stages\[0\] is \[\[\[\]\]\]; expected an object with the fields of Phase"),
        (changed(model={"taps": [10**400] * 4}), r"model.taps\[0\] is a number of more than 64 bits"),
        (changed(losses={"match_layers": [[0]]}), r"losses.match_layers\[0\] is \[0\]; expected a whole number"),
        (changed(optimiser={"kind": []}), r"optimiser.kind is \[\]; expected one of"),
        (changed(seed=2**40), "recipe: seed is 1099511627776; expected a whole number of at least 0 and less than"),
        (changed(stages=3), "recipe: stages is 3; expected a list"),
        (changed(stages=[PHASE | {"speed": 2}]), r"stages\[0\] has unknown fields \['speed'\]"),
        (changed(stages=[PHASE | {"steps": 0}]), r"stages\[0\].steps is 0; expected a whole number of at least 1"),
        (changed(stages=[PHASE | {"steps": 2.5}]), r"stages\[0\].steps is 2.5; expected a whole number"),
        (changed(stages=[PHASE | {"steps": True}]), r"stages\[0\].steps is True; expected a whole number"),
        (changed(stages=[PHASE | {"batch": "2"}]), r"stages\[0\].batch is '2'; expected a whole number"),
        (changed(stages=[PHASE | {"frames": []}]), r"stages\[0\].frames is \[\]; expected a list of at least 1"),
        (
            changed(stages=[PHASE | {"frames": [2, -1]}]),
            r"stages\[0\]: frames is -1; expected a whole number",
        ),
        (changed(stages=[PHASE | {"frames": 2}]), r"stages\[0\].frames is 2; expected a list"),
        (
            changed(stages=[PHASE | {"dynamic": 1.5}]),
            r"stages\[0\]: dynamic is 1.5; expected a number",
        ),
        (changed(stages=[PHASE | {"height": 30}]), "multiples of the model's patch_size 14"),
        (changed(stages=[PHASE | {"sizes": [[28, 30]]}]), "28 x 30 pixels; expected multiples of the model's"),
        (changed(stages=[PHASE | {"pitch": [0, 70]}]), r"stages\[0\]: pitch\[1\] is 70.0; expected a number"),
        (changed(stages=[PHASE | {"suppressed_pairs": [0.5, 0.2]}]), r"suppressed_pairs is \(0.5, 0.2\); expected"),
        (
            changed(stages=[PHASE | {"field_of_view": [80, 40]}]),
            r"field_of_view is \(80.0, 40.0\); expected two numbers",
        ),
        (changed(stages=[PHASE | {"boxes": 65}]), r"stages\[0\]: boxes is 65; expected a whole number"),
        (changed(stages=[PHASE | {"suppressed_pairs": [0, 0]}]), r"suppressed_pairs is \(0.0, 0.0\); expected"),
        (changed(stages=[PHASE | {"sizes": [[28]]}]), r"stages\[0\].sizes\[0\] is \[28\]; expected a list of 2"),
        (
            changed(stages=[PHASE | {"sizes": [[0, 28]]}]),
            r"sizes\[0\]\[0\] is 0; expected a whole number",
        ),
        (
            changed(stages=[PHASE | {"sizes": [[28, 42]]}]),
            r"sizes is .*; expected sizes other than \(28, 42\)",
        ),
        (changed(stages=[PHASE | {"sizes": [[28, 28]] * 2}]), r"stages\[0\]: sizes is .*, each once"),
        (changed(stages=[PHASE | {"sizes": [[28, 28]] * 17}]), r"stages\[0\].sizes .* at most 16"),
        (changed(optimiser={"learning_rate": 0}), "optimiser.learning_rate is 0; expected a number of more than 0"),
        (changed(optimiser={"learning_rate": float("nan")}), "is not JSON"),
        (changed(optimiser={"learning_rate": 10**400}), "optimiser.learning_rate is a number of more than 64 bits"),
        (changed(optimiser={"b2": 1}), "optimiser.b2 is 1; expected a number of at least 0 and less than 1"),
        (changed(optimiser={"kind": "sgd"}), "optimiser.kind is 'sgd'; expected one of"),
        (changed(optimiser={"warmup_steps": 7}), "warm-up and decay take"),
        (changed(optimiser={"momentum": 0.9}), r"unknown fields \['momentum'\]"),
        (changed(model={"depth": "4"}), "depth"),
        (changed(model={"size": 4}), "unknown fields"),
        (changed(losses={"depth": -1}), "losses.depth is -1"),
        (changed(losses={"smell": 1}), "unknown fields"),
        (changed(trainable="camera"), "recipe: trainable is 'camera'"),
        (changed(compute_dtype="float16"), "recipe: compute_dtype"),
        (changed(untrained=["neck"]), r"recipe.untrained has \['neck'\]"),
        (changed(untrained="track_head"), "recipe: untrained is"),
        (changed(seed=-1), "recipe: seed is -1"),
        (changed(remat=1), "recipe: remat is 1; expected true or false"),
        (changed(name="a\nb"), "recipe.name"),
    ],
)
def test_bad_recipes_are_named(text, says):
    with pytest.raises(InputError, match=says):
        Recipe.from_json(text)


def test_reading_a_file(tmp_path):
    path = tmp_path / "recipe.json"
    path.write_text(RECIPE.to_json())
    assert read_recipe(path) == RECIPE
    for content, says in (
        (b"\xff\xfe", "is not JSON"),
        (b"{}", r"recipe .*recipe.json lacks the field 'name'"),
        (b" " * (1 << 21), "bytes"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=says):
            read_recipe(path)
    with pytest.raises(InputError, match="cannot read"):
        read_recipe(tmp_path / "none.json")


def test_lists_in_python_become_tuples():
    assert LossWeights(match_layers=[0, 1]).match_layers == (0, 1)  # type: ignore[arg-type]


DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("path", sorted(DOCS.glob("*/*.json")), ids=lambda path: path.stem)
def test_recipes_of_the_docs_load(path):
    recipe = read_recipe(path)
    assert Recipe.from_json(recipe.to_json()) == recipe
    for phase, read in zip(json.loads(path.read_text())["stages"], json.loads(recipe.to_json())["stages"], strict=True):
        assert read == read | phase  # later fields have their defaults


ON_A_GPU = read_recipe(DOCS / "recipes" / "gpu.json")


@pytest.mark.parametrize(
    ("stage", "size"),
    [
        pytest.param(stage, size, marks=() if (stage, size) == (-1, 0) else pytest.mark.proof)
        for stage in (-1, -2)
        for size in range(len(ON_A_GPU.stages[stage].all_sizes))
    ],
)
def test_the_recipe_for_a_gpu_fits_the_wheel_and_takes_a_step(stage, size):
    """The model takes at most 24 MB in bfloat16; shapes of a step of a phase with the most frames."""
    state, phase = state_shapes(ON_A_GPU, init_probes(0, ON_A_GPU.model)), ON_A_GPU.stages[stage]
    assert 2 * sum(leaf.size for leaf in jax.tree.leaves(state.trained["model"])) < 24e6
    step, textures = partial(loss_and_gradient, recipe=ON_A_GPU, objective=objective), load_textures("training")
    draw = partial(make_batch, textures=textures, phase=phase.of_size(size), frames=max(phase.frames))
    metrics, gradient = jax.eval_shape(step, state.trained, jax.eval_shape(draw, jax.random.key(0)))
    assert metrics["loss"].shape == ()
    assert jax.tree.structure(gradient) == jax.tree.structure(state.ema)


def test_fields_of_a_phase_reach_its_scenes():
    changed = {"pitch": (1, 2), "roll": 3, "field_of_view": (40, 50), "boxes": 6, "ellipsoids": 7, "cylinders": 8}
    scenes = Phase(1, 8, (2,), 28, 42, dynamic=0.5, motion=(0.2, 0.3), **changed).scenes(2)
    assert scenes == SceneConfig(28, 42, 2, 0.5, motion=(0.2, 0.3), **changed)


def test_gamma_makes_clips_darker_and_brighter():
    textures, phase = load_textures("training"), Phase(1, 8, (2,), 28, 28)

    def spread(gamma: float) -> float:
        draw = jax.jit(make_batch, static_argnames=("phase", "frames"))
        batch = draw(jax.random.key(0), textures, phase=dataclasses.replace(phase, gamma=gamma), frames=2)
        return float(np.log(batch.clips.images.mean(axis=(1, 2, 3, 4))).std())

    assert spread(4.0) > 1.5 * spread(0.0)
    with pytest.raises(InputError, match="gamma is 5"):
        dataclasses.replace(phase, gamma=5)
