"""Cameras guessed without images: hand-computed values and properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.blind import (
    best_angular_velocity,
    line_centre_error,
    mean_angular_velocity,
    still,
    still_centre_error,
    turning,
)
from tests.evaluation.metrics.test_trajectory import about, cameras, random_cameras, seeds
from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.geometry.similarity import centres, umeyama_sim3


@settings(max_examples=20)
@given(seed=seeds)
def test_blind_centres(seed):
    truth = random_cameras(np.random.default_rng(seed))
    points = centres(truth)
    assert still_centre_error(truth) == pytest.approx(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    line = np.arange(len(truth))[:, None] * np.array([0.3, -0.2, 0.9])
    offsets = umeyama_sim3(line, points, allow_line=True).apply(line) - points
    assert line_centre_error(truth) == pytest.approx(np.sqrt((offsets**2).sum(axis=1).mean()), rel=1e-6)
    assert centre_error(truth, truth) <= line_centre_error(truth) <= still_centre_error(truth)


def test_a_line_has_no_line_error():
    assert line_centre_error(cameras(np.arange(5)[:, None] * np.array([1.0, 2, 3]) + 1)) == pytest.approx(0, abs=1e-12)


def test_turning_by_hand():
    poses = turning(np.array([0, np.radians(15), 0]), 3)
    assert np.allclose(poses[:, :, :3], about(1, [0, 15, 30]).as_matrix())
    assert not poses[:, :, 3].any()
    assert np.degrees(mean_angular_velocity(poses)) == pytest.approx([0, 15, 0])


@settings(max_examples=10)
@given(seed=seeds, speed=st.floats(0.001, 0.3))
def test_the_oracle_finds_a_constant_rate_and_is_never_worse_than_none(seed, speed):
    generator = np.random.default_rng(seed)
    rate = generator.normal(size=3)
    rate *= speed / np.linalg.norm(rate)
    steady = turning(rate, 8)
    assert rotation_error(turning(best_angular_velocity(steady), 8), steady) < 1e-4
    shaken = Rotation.from_rotvec(0.2 * generator.normal(size=(8, 3))) * Rotation.from_matrix(steady[:, :, :3])
    wandering = cameras(np.zeros((8, 3)), shaken * Rotation.random(rng=generator))
    best = rotation_error(turning(best_angular_velocity(wandering), 8), wandering)
    assert best <= rotation_error(still(8), wandering) + 1e-6
    for _ in range(5):
        assert best <= rotation_error(turning(rate + 0.1 * generator.normal(size=3), 8), wandering) + 1e-6


def test_the_oracle_is_the_median_rate_in_a_plane():
    """About one axis the mean angle is sum |t_i w - a_i| / N: a weighted median, whose minimum is found exactly."""
    angles = np.radians([3, 5, 12, 10, 20])
    truth = cameras(np.zeros((6, 3)), about(2, np.degrees(np.r_[0, angles])))
    times = np.arange(1, 6)
    exact = min(np.abs(times * rate - angles).mean() for rate in angles / times)
    found = rotation_error(turning(best_angular_velocity(truth), 6), truth)
    assert np.radians(found) == pytest.approx(exact, rel=1e-4)


@pytest.mark.parametrize("function", [best_angular_velocity, mean_angular_velocity, still_centre_error])
def test_a_single_pose_has_no_rate(function):
    with pytest.raises(InputError, match="expected at least 2"):
        function(still(1))
