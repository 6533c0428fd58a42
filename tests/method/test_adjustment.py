"""The adjustment on matches of generated scenes: exact, and with moving parts."""

import dataclasses

import jax
import numpy as np
import pytest

from tests.shared.static_world import GRID, StaticWorld
from vggtjax.cameras import Cameras
from vggtjax.method.matching.adjustment import Adjustment, adjust

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


def test_without_iterations_only_the_differences_are_measured(clip):
    how = dataclasses.replace(FREE, annealed=())
    made = fast(clip.depth, Cameras(clip.poses, clip.K), clip.matched, clip.weight, GRID, how)
    np.testing.assert_allclose(made.depth, clip.depth, rtol=1e-5)
    assert np.linalg.norm(made.position - clip.matched, axis=-1)[clip.weight > 0].max() < 1e-3


@pytest.mark.parametrize("focal_prior", [None, 0.1])
def test_64_bits_of_jax_leave_it_in_32(clip, focal_prior):
    arguments = (np.float32(clip.depth), Cameras(np.float32(clip.poses), np.float32(clip.K)))
    arguments += (np.float32(clip.matched), np.float32(clip.weight), GRID, Adjustment(focal_prior=focal_prior))
    plain = fast(*arguments)
    with jax.enable_x64(True):
        wide = fast(*arguments)
    for own, other in zip(plain, wide, strict=True):
        assert other.dtype == np.float32
        np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-4)
