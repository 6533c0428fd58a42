"""Where training from nothing starts."""

import dataclasses

import jax
import numpy as np
import pytest

from tests.training_runs import RECIPE
from vggtjax.errors import InputError
from vggtjax.network.model import init_params
from vggtjax.training.recipe import Recipe, Start
from vggtjax.training.state import start_params


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


def test_a_start_of_no_scale_is_refused():
    with pytest.raises(InputError, match=r"start\.layer_scale is 0"):
        Start(layer_scale=0.0)
