"""Where training from nothing starts."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.tiny import tiny_model
from tests.shared.training_runs import RECIPE, init_probes
from vggtjax.config import MotionConfig
from vggtjax.errors import CheckpointError, InputError
from vggtjax.network.backbone import encode
from vggtjax.network.model import forward
from vggtjax.pipeline.pretrained.embedded import demo_model
from vggtjax.training.recipe import Recipe, Start, read_recipe
from vggtjax.training.start import adapted, start_params
from vggtjax.training.state import initial_state


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
    tokens = [
        run(weights, images, config) for weights, config in ((model.params, model.config), (params, recipe.model))
    ]
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
