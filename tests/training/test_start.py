"""Where training from nothing starts."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.training_runs import RECIPE, init_probes
from vggtjax.errors import CheckpointError, InputError
from vggtjax.network.backbone import encode
from vggtjax.network.model import init_params
from vggtjax.pretrained.embedded import demo_model
from vggtjax.training.recipe import Recipe, Start, read_recipe
from vggtjax.training.state import adapted, initial_state, start_params


def test_the_default_is_vggts_start():
    plain = init_params(RECIPE.seed, RECIPE.model)
    assert jax.tree.all(jax.tree.map(np.array_equal, start_params(RECIPE), plain))


def test_tied_keys_and_layer_scale():
    recipe = dataclasses.replace(RECIPE, start=Start(layer_scale=0.3, tied_keys=True))
    params = start_params(recipe)["aggregator"]
    for blocks, tied in (("global_blocks", True), ("frame_blocks", False)):
        query, key, value = np.split(np.asarray(params[blocks]["attention"]["qkv"]["kernel"]), 3, axis=-1)
        assert np.array_equal(query, key) == tied
        assert not np.array_equal(query, value)
        assert np.allclose(params[blocks]["scale1"], 0.3)
    assert Recipe.from_json(recipe.to_json()) == recipe


def test_the_embedded_model_starts_its_last_recipe():
    """The recipe has the default cues, and images of another size."""
    recipe = read_recipe(Path(__file__).parents[2] / "docs" / "embedded" / "5-four-frames.json")
    model = demo_model()
    assert (model.config.image_size, model.config.motion) != (recipe.model.image_size, recipe.model.motion)
    params = adapted(model, recipe.model)
    jax.eval_shape(lambda params: initial_state(recipe, init_probes(0, recipe.model), params), params)
    same = adapted(model, dataclasses.replace(recipe.model, image_size=model.config.image_size))
    assert jax.tree.all(jax.tree.map(np.array_equal, same, model.params))
    images = jnp.asarray(np.random.default_rng(0).uniform(size=(1, 1, 112, 112, 3)), jnp.float32)
    tokens = [
        encode(weights, images, config) for weights, config in ((model.params, model.config), (params, recipe.model))
    ]
    np.testing.assert_allclose(tokens[0], tokens[1], atol=1e-5)  # the backbone resizes the table alike
    with pytest.raises(CheckpointError, match="it has embed_dim 128, not 256, num_heads 4, not 8; use these values in"):
        adapted(model, dataclasses.replace(recipe.model, embed_dim=256, num_heads=8))


def test_a_start_of_no_scale_is_refused():
    with pytest.raises(InputError, match=r"start\.layer_scale is 0"):
        Start(layer_scale=0.0)
