import dataclasses
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.shared.training_runs import RECIPE
from vggtjax.training.optimiser import make_optimiser as make_typed_optimiser
from vggtjax.training.optimiser import make_schedule
from vggtjax.training.recipe import OptimiserConfig, Recipe

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
