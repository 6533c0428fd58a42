"""Motion by matches that do not fit a static world, and the masks it gives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.static_world import GRID, PATCH, StaticWorld
from vggtjax.method.edges import follow_edges
from vggtjax.method.matching.matched_mask import mine_matched_mask
from vggtjax.method.matching.matched_motion import motion
from vggtjax.network.heads.pose import encode_pose

find = jax.jit(motion, static_argnames="grid")
SIZE = (GRID[0] * PATCH, GRID[1] * PATCH)


@pytest.fixture(scope="module")
def world():
    return StaticWorld()


def test_patches_that_move_differ_from_a_static_world(world):
    saliency = jnp.full(world.depth.shape, 0.5)
    moves = np.zeros((len(world.depth), *GRID), bool)
    moves[:, 2:4, 1:3] = True
    moves = moves.reshape(len(moves), -1) & (world.weight.sum(axis=1) > 0)
    depth = jnp.asarray(world.depth, jnp.float32)
    still = find(world.matches(), saliency, depth, world.cameras, GRID)
    found = find(world.matches(moves), saliency, depth, world.cameras, GRID)
    assert still.is_matched
    assert found.is_matched
    assert (still.score < 1.5 * jnp.median(still.score)).all()
    assert found.score[moves].min() > found.score[~moves].max()
    assert np.abs(still.world.position - world.matched)[world.weight > 0].max() < 0.02


def test_the_gradient_of_motion_agrees_with_differences(world):
    """The score by the matches' positions, through both rounds of the adjustment."""
    matches, depth = (jax.tree.map(lambda x: np.asarray(x, np.float64), x) for x in (world.matches(), world.depth))
    towards = np.random.default_rng(2).normal(size=matches.position.shape)
    cameras = jax.tree.map(lambda x: np.asarray(x, np.float64), world.cameras)

    def score(step):
        moved = matches._replace(position=matches.position + (0.05 + step) * towards)
        return jnp.log(motion(moved, jnp.full(depth.shape, 0.5), depth, cameras, GRID).score).sum()

    with jax.enable_x64(True):
        slope = jax.jit(jax.grad(score))(0.0)
        at = [jax.jit(score)(step) for step in (1e-6, -1e-6)]
        assert np.allclose(slope, (at[0] - at[1]) / 2e-6, rtol=1e-3)


@pytest.mark.parametrize("wrong", ["no match comes back", "two frames", "depth is not a number", "no texture"])
def test_without_matches_the_mask_is_that_of_the_similarities(world, wrong):
    frames = 2 if wrong == "two frames" else len(world.depth)
    generator = np.random.default_rng(0)
    gram_mask = jnp.asarray(generator.random((1, frames, *SIZE)) < 0.1)
    matches = jax.tree.map(lambda x: x[None, :frames, : 2 if frames == 2 else None], world.matches())
    if wrong == "no match comes back":
        matches = matches._replace(cycle=matches.cycle + 2)
    if wrong == "no texture":  # attention without a maximum: the first patch everywhere
        matches = matches._replace(position=0 * matches.position + 1, cycle=matches.cycle + 3)
    depth = np.full((1, frames, *SIZE), np.nan if wrong == "depth is not a number" else 1, np.float32)
    poses, intrinsics = (jnp.asarray(x[None, :frames]) for x in world.cameras)
    pose = encode_pose(poses, intrinsics, GRID)
    images, saliency = jnp.full((1, frames, *SIZE, 3), 0.5), jnp.full((1, frames, *GRID), 0.5)
    mined = jax.jit(mine_matched_mask)(matches, gram_mask, saliency, images, jnp.asarray(depth), pose)
    assert (mined.dynamic_mask == gram_mask).all()
    assert not mined.is_matched.any()
    assert np.isfinite(mined.motion).all()


def test_values_follow_edges_as_in_a_slow_filter():
    patch, H, W = 4, 9, 11
    generator = np.random.default_rng(0)
    values, images = generator.random((1, 1, H, W)).astype(np.float32), generator.random((1, 1, H, W, 3)) / 4
    expected = np.zeros((H, W))
    for y, x in np.ndindex(H, W):
        total = weights = 0.0
        for dy in range(-patch, patch + 1):
            for dx in range(-patch, patch + 1):
                near = min(max(y + dy, 0), H - 1), min(max(x + dx, 0), W - 1)
                colour = ((images[0, 0, y, x] - images[0, 0][near]) ** 2).sum() / (2 * 0.1**2)
                weight = np.exp(-colour - (dy**2 + dx**2) / (2 * (0.625 * patch) ** 2))
                total, weights = total + weight * values[0, 0][near], weights + weight
        expected[y, x] = total / weights
    made = jax.jit(partial(follow_edges, patch_size=patch))(jnp.asarray(values), jnp.asarray(images, jnp.float32))
    assert np.allclose(made[0, 0], expected, atol=1e-5)
