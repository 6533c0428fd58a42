"""The adjustment on matches of generated scenes: exact, and with moving parts."""

import dataclasses

import jax
import numpy as np
import pytest

from tests.static_world import GRID, PATCH, StaticWorld
from vggtjax.cameras import Cameras
from vggtjax.method.adjusted_cameras import adjusted_cameras
from vggtjax.method.adjustment import Adjustment, adjust

FREE = Adjustment(depth_prior=100.0, rotation_prior=100.0, translation_prior=100.0)
fast = jax.jit(adjust, static_argnames=("grid", "how"))


@pytest.fixture(scope="module")
def clip():
    return StaticWorld()


def turned(poses, true):
    """Return the angles in degrees between the rotations of two sets of cameras."""
    return np.degrees(2 * np.arcsin(np.linalg.norm(poses[..., :3] - true[..., :3], axis=(1, 2)) / 8**0.5))


def test_matches_without_noise_give_the_exact_cameras_and_depths(clip):
    depth, poses = clip.disturbed()
    how = dataclasses.replace(FREE, annealed=(1.0,) * 20)
    made = fast(depth, Cameras(poses, clip.K), clip.matched, clip.weight, GRID, how)
    error = np.linalg.norm(made.position - clip.matched, axis=-1)[clip.weight > 0]
    assert error.max() < 1e-4
    scale = np.median(clip.depth / made.depth)
    assert turned(made.camera_from_world, clip.poses).max() < 1e-3
    relative = clip.poses[:, :, 3] - np.einsum(
        "sij,j->si", clip.poses[:, :, :3] @ clip.poses[0, :, :3].T, clip.poses[0, :, 3]
    )
    own = made.camera_from_world
    own = own[:, :, 3] - np.einsum("sij,j->si", own[:, :, :3] @ own[0, :, :3].T, own[0, :, 3])
    assert np.abs(scale * own - relative).max() < 1e-3 * np.median(clip.depth)


def test_two_fifths_of_movers_do_not_turn_the_cameras(clip):
    depth, poses = clip.disturbed()
    moves = np.random.default_rng(1).random(clip.depth.shape) < 0.4
    matched = clip.matches(moves).position
    made = fast(depth, Cameras(poses, clip.K), matched, clip.weight, GRID)
    before, after = turned(poses, clip.poses)[1:], turned(made.camera_from_world, clip.poses)[1:]
    assert after.mean() < 0.35 * before.mean()
    error = np.linalg.norm(made.position - matched, axis=-1)
    still, moving = (np.median(error[(clip.weight > 0) & which[:, None]]) for which in (~moves, moves))
    assert moving > 10 * still


@pytest.mark.parametrize("come_back", [True, False])
def test_cameras_are_adjusted_to_what_does_not_move_if_matches_come_back(clip, come_back):
    depth, poses = clip.disturbed()
    moves = np.random.default_rng(1).random(clip.depth.shape) < 0.4

    def pixels(patches):
        return np.kron(patches.reshape(-1, *GRID), np.ones((1, PATCH, PATCH), patches.dtype))[None]

    given = Cameras(poses[None], (clip.K * np.array([[PATCH], [PATCH], [1]])).astype(np.float32)[None])
    adjusted = jax.jit(adjusted_cameras, static_argnames="grid")
    made = []
    for matches in (clip.matches(moves), clip.matches()):
        matches = matches._replace(cycle=matches.cycle + (0 if come_back else 2))
        every = jax.tree.map(lambda x: x[None], matches)
        made.append(adjusted(given, pixels(depth), every, pixels(moves), GRID))
    assert all(np.array_equal(made[0].intrinsics, cameras.intrinsics) for cameras in (given, made[1]))
    poses_made = made[0].camera_from_world
    assert np.allclose(poses_made, made[1].camera_from_world, atol=1e-5)  # what moves does not count
    if come_back:
        assert turned(poses_made[0], clip.poses)[1:].mean() < 0.85 * turned(poses, clip.poses)[1:].mean()
    else:
        assert np.array_equal(poses_made, given.camera_from_world)
