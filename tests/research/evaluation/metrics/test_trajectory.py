"""Sim(3) alignment and trajectory errors: hand-computed values, properties, and what a blind guess scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.test_cameras import random_similarity
from vggtjax.cameras import align, checked_centres, umeyama_sim3
from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.trajectory import associate, centre_error, rotation_error, trajectory_errors


def cameras(points, rotation=None) -> np.ndarray:
    """Poses [S, 3, 4] with the given centres; unturned unless rotations (camera from world) are given."""
    points = np.asarray(points, float)
    turned = np.tile(np.eye(3), (len(points), 1, 1)) if rotation is None else rotation.as_matrix()
    return np.concatenate([turned, -np.einsum("sij,sj->si", turned, points)[:, :, None]], axis=2)


def still(frames) -> np.ndarray:
    return cameras(np.zeros((frames, 3)))


def about(axis, degrees) -> Rotation:
    """Rotations about a coordinate axis."""
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * np.eye(3)[axis])


seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=15)
@given(seed=seeds, mirrored=st.booleans())
def test_umeyamas_similarity_is_the_best(seed, mirrored):
    """Noise, and a mirror image, for which the determinant has to be corrected."""
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(8, 3))
    target = random_similarity(generator).apply(source * [1, 1, -1 if mirrored else 1])
    target += 0.3 * generator.normal(size=(8, 3))
    best = umeyama_sim3(source, target)
    turned = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))[0]
    assert np.allclose(turned.as_matrix(), best.rotation, atol=1e-6)  # scale does not change the best rotation
    left = best.apply(source) - target
    assert np.allclose(left.mean(axis=0), 0)
    assert (left * (best.apply(source) - best.apply(source).mean(axis=0))).sum() == pytest.approx(0, abs=1e-9)


def test_rotation_error_by_hand():
    about_y = about(1, [10, 20, 40])
    truth = cameras(np.zeros((3, 3)), about_y)
    predicted = cameras(np.ones((3, 3)), about(1, [0, 16, 28]))
    # Relative to their first frames: truth 10, 30; prediction 16, 28.
    assert rotation_error(predicted, truth) == pytest.approx((6 + 2) / 2)
    assert rotation_error(still(3), truth) == pytest.approx((10 + 30) / 2)
    truth = cameras([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]])
    turned = cameras(checked_centres(truth), about(2, [0, 3, 3, 7]))
    errors = trajectory_errors(world_from(turned), world_from(truth))  # steps turn by 3, 0 and 4 degrees too much
    assert errors.rre == pytest.approx(np.sqrt((9 + 0 + 16) / 3))
    # Each step is seen from a camera turned by 0, 3, 3 degrees: a step of length 1 is off by 2 sin(angle / 2).
    assert errors.rte == pytest.approx(np.sqrt(2 / 3) * 2 * np.sin(np.radians(1.5)))


def world_from(camera_from_world) -> np.ndarray:
    """The same poses as [S, 4, 4] from camera to world."""
    full = np.tile(np.eye(4), (len(camera_from_world), 1, 1))
    full[:, :3] = camera_from_world
    return np.linalg.inv(full)


def wandering(generator, frames=30, noise=0.05) -> tuple[np.ndarray, np.ndarray]:
    """A smooth walk [S, 4, 4] and the same with noise on centres and rotations, in another world and scale."""
    centres_ = np.cumsum(0.1 * generator.normal(size=(frames, 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(0.1 * generator.normal(size=(frames, 3)), axis=0))
    shaken = Rotation.from_rotvec(noise * generator.normal(size=(frames, 3))) * turns
    truth = cameras(centres_, turns)
    predicted = cameras(centres_ + noise * generator.normal(size=(frames, 3)), shaken)
    return world_from(align(predicted, random_similarity(generator))), world_from(truth)


@pytest.mark.parametrize("how", ["sim3", "se3", "first"])
def test_evo_agrees(how):
    """An independent program (Grupp 2017): APE and RPE of the translation, RPE of the angle, RMSE, one frame apart."""
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is a test-only cross-check")
    trajectory = pytest.importorskip("evo.core.trajectory", reason="evo is a test-only cross-check")
    predicted, truth = wandering(np.random.default_rng(0), noise=0.1)
    reference, estimate = (trajectory.PosePath3D(poses_se3=list(poses)) for poses in (truth, predicted))
    if how == "first":
        estimate.align_origin(reference)
    else:
        estimate.align(reference, correct_scale=how == "sim3")
    relation = metrics.PoseRelation
    wanted = []
    for measure in (
        metrics.APE(relation.translation_part),
        metrics.RPE(relation.translation_part, 1, metrics.Unit.frames),
        metrics.RPE(relation.rotation_angle_deg, 1, metrics.Unit.frames),
    ):
        measure.process_data((reference, estimate))
        wanted.append(measure.get_statistic(metrics.StatisticsType.rmse))
    errors = trajectory_errors(predicted, truth, how)
    assert errors == pytest.approx(tuple(wanted), abs=1e-6, rel=1e-6)
    if how == "sim3":
        assert errors.ate == pytest.approx(centre_error(*(np.linalg.inv(poses)[:, :3] for poses in (predicted, truth))))


MANY, FEW, STILL = (world_from(poses) for poses in (cameras(np.eye(4, 3)), still(2), still(4)))
TURNING = cameras(np.tile([3.0, -1, 4], (4, 1)), about(2, [0, 9, 18, 27])).astype(np.float32)  # in place, but rounded


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: umeyama_sim3(np.arange(4)[:, None] * [1, 2, 3], np.eye(4, 3)), "source points lie on one line"),
        (lambda: centre_error(TURNING, cameras(np.eye(4, 3))), "predicted cameras do not move"),
        (lambda: centre_error(cameras(np.eye(4, 3)), still(4)), "true cameras do not move"),
        (lambda: trajectory_errors(MANY[:, :3], MANY), r"shape \(4, 3, 4\); expected world-from-camera \[S, 4, 4\]"),
        (lambda: trajectory_errors(MANY, 2 * MANY), "true poses are not rigid"),
        (lambda: associate(np.zeros(5000), np.zeros(5000)), "25000000 pairs of times"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()


@settings(max_examples=30)
@given(seed=seeds, tolerance=st.floats(0.001, 0.1))
def test_associate_is_greedy_over_all_pairs(seed, tolerance):
    generator = np.random.default_rng(seed)
    times, other = np.sort(generator.random(12)), np.sort(generator.random(9))
    pairs = sorted((abs(a - b), i, j) for i, a in enumerate(times) for j, b in enumerate(other))
    wanted = []
    for apart, i, j in pairs:
        if apart < tolerance and i not in [a for a, _ in wanted] and j not in [b for _, b in wanted]:
            wanted.append((i, j))
    assert associate(times, other, tolerance).tolist() == [list(pair) for pair in sorted(wanted)]
