"""Sim(3) alignment and trajectory errors: hand-computed values, properties, and what a blind guess scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.trajectory import associate, centre_error, from_first, rotation_error, trajectory_errors
from vggtjax.geometry.similarity import Similarity, align, centres, umeyama_sim3


def cameras(points, rotation=None) -> np.ndarray:
    """Poses [S, 3, 4] with the given centres; unturned unless rotations (camera from world) are given."""
    points = np.asarray(points, float)
    turned = np.tile(np.eye(3), (len(points), 1, 1)) if rotation is None else rotation.as_matrix()
    return np.concatenate([turned, -np.einsum("sij,sj->si", turned, points)[:, :, None]], axis=2)


def still(frames) -> np.ndarray:
    return cameras(np.zeros((frames, 3)))


def random_cameras(generator, frames=7) -> np.ndarray:
    return cameras(generator.normal(size=(frames, 3)), Rotation.random(frames, rng=generator))


def random_similarity(generator) -> Similarity:
    rotation = Rotation.random(rng=generator).as_matrix()
    return Similarity(float(np.exp(generator.normal())), rotation, 5 * generator.normal(size=3))


def about(axis, degrees) -> Rotation:
    """Rotations about a coordinate axis."""
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * np.eye(3)[axis])


seeds = st.integers(0, 2**32 - 1)


def test_centres_are_minus_r_transposed_t():
    quarter = Rotation.from_euler("z", 90, degrees=True)
    poses = np.concatenate([quarter.as_matrix(), [[1], [2], [3]]], axis=1)[None]
    assert np.allclose(centres(poses), [[-2, 1, -3]])
    assert np.allclose(centres(cameras([[4, 5, 6]])), [[4, 5, 6]])


def test_umeyama_by_hand():
    source = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    target = 2 * source[:, [1, 0, 2]] * [-1, 1, 1] + [3, 0, 0]  # (x, y, z) -> (-y, x, z): a quarter turn about z
    found = umeyama_sim3(source, target)
    assert found.scale == pytest.approx(2)
    assert np.allclose(found.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(found.translation, [3, 0, 0])


def test_umeyama_turns_a_mirrored_triangle_over():
    """The triangles of Umeyama 1991: mirrored in their plane, a half turn apart in space."""
    source = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0.0]])
    target = np.array([[0, 0, 0], [-1, 0, 0], [0, 2, 0.0]])
    found = umeyama_sim3(source, target)
    assert found.scale == pytest.approx(1)
    assert np.allclose(found.apply(source), target)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


@settings(max_examples=60)
@given(seed=seeds, count=st.integers(4, 40))
def test_umeyama_recovers_any_similarity(seed, count):
    generator = np.random.default_rng(seed)
    source, wanted = generator.normal(size=(count, 3)), random_similarity(generator)
    found = umeyama_sim3(source, wanted.apply(source))
    assert found.scale == pytest.approx(wanted.scale, rel=1e-8)
    assert np.allclose(found.rotation, wanted.rotation, atol=1e-7)
    assert np.allclose(found.translation, wanted.translation, atol=1e-6)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


@settings(max_examples=15)
@given(seed=seeds, mirrored=st.booleans())
def test_no_similarity_is_better_than_umeyamas(seed, mirrored):
    """Noise, and a mirror image, for which the determinant has to be corrected; scipy searches around it."""
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(8, 3))
    target = random_similarity(generator).apply(source * [1, 1, -1 if mirrored else 1]) + 0.3 * generator.normal(
        size=(8, 3)
    )
    best = umeyama_sim3(source, target)

    def error(x):
        tried = Similarity(np.exp(x[0]), Rotation.from_rotvec(x[1:4]).as_matrix(), x[4:])
        return ((tried.apply(source) - target) ** 2).sum()

    start = np.r_[np.log(best.scale), Rotation.from_matrix(best.rotation).as_rotvec(), best.translation]
    found = minimize(error, start + 0.05 * generator.normal(size=7), method="BFGS")
    assert error(start) <= found.fun + 1e-6
    turned = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))[0]
    assert np.allclose(turned.as_matrix(), best.rotation, atol=1e-6)  # scale does not change the best rotation


@pytest.mark.parametrize(
    ("source", "target", "sentence"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "2 source points; expected at least 3"),
        (np.zeros((4, 2)), np.zeros((4, 2)), r"expected \[N, 3\]"),
        (np.eye(3), np.eye(4, 3), "3 points and target 4"),
        (np.full((3, 3), np.nan), np.eye(3), "not finite"),
        (np.ones((5, 3)), np.eye(5, 3), "source points all coincide"),
        (np.eye(5, 3), np.full((5, 3), 7.1), "target points all coincide"),
        (np.arange(4)[:, None] * [1, 2, 3], np.eye(4, 3), "source points lie on one line"),
    ],
)
def test_degenerate_points_are_one_sentence(source, target, sentence):
    with pytest.raises(InputError, match=sentence):
        umeyama_sim3(source, target)


def test_points_on_a_line_can_be_allowed():
    line = np.arange(5)[:, None] * np.array([1.0, 2, 3])
    wanted = random_similarity(np.random.default_rng(0))
    found = umeyama_sim3(line, wanted.apply(line), allow_line=True)
    assert found.scale == pytest.approx(wanted.scale)
    assert np.allclose(found.apply(line), wanted.apply(line))


@settings(max_examples=30)
@given(seed=seeds)
def test_errors_vanish_for_the_same_trajectory_in_another_world(seed):
    generator = np.random.default_rng(seed)
    truth = random_cameras(generator)
    moved = align(truth, random_similarity(generator))
    assert centre_error(moved, truth) == pytest.approx(0, abs=1e-7)
    assert rotation_error(moved, truth) == pytest.approx(0, abs=1e-5)
    errors = trajectory_errors(world_from(moved), world_from(truth))
    assert errors.rte == pytest.approx(0, abs=1e-7)
    assert errors.rre == pytest.approx(0, abs=1e-5)


def test_aligning_keeps_the_images():
    generator = np.random.default_rng(1)
    poses, similarity, points = random_cameras(generator), random_similarity(generator), generator.normal(size=(9, 3))

    def seen(cameras, world):
        inside = np.einsum("sij,nj->sni", cameras[:, :, :3], world) + cameras[:, None, :, 3]
        return inside[..., :2] / inside[..., 2:]

    assert np.allclose(seen(poses, points), seen(align(poses, similarity), similarity.apply(points)))


def test_centre_error_by_hand():
    truth = cameras([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    pulled = cameras([[2, 0, 0], [-2, 0, 0], [0, 1, 0], [0, -1, 0]])
    # The best scale is (2 + 2 + 1 + 1) / (4 + 4 + 1 + 1) = 0.6: errors 0.2, 0.2, 0.4, 0.4.
    assert centre_error(pulled, truth) == pytest.approx(np.sqrt((2 * 0.04 + 2 * 0.16) / 4))


def test_rotation_error_by_hand():
    about_y = about(1, [10, 20, 40])
    truth = cameras(np.zeros((3, 3)), about_y)
    predicted = cameras(np.ones((3, 3)), about(1, [0, 16, 28]))
    # Relative to their first frames: truth 10, 30; prediction 16, 28.
    assert rotation_error(predicted, truth) == pytest.approx((6 + 2) / 2)
    assert rotation_error(still(3), truth) == pytest.approx((10 + 30) / 2)
    assert from_first(truth).magnitude() == pytest.approx(np.radians([10, 30]))


def test_relative_errors_by_hand():
    truth = cameras([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]])
    turned = cameras(centres(truth), about(2, [0, 3, 3, 7]))
    errors = trajectory_errors(world_from(turned), world_from(truth))  # steps turn by 3, 0 and 4 degrees too much
    assert errors.rre == pytest.approx(np.sqrt((9 + 0 + 16) / 3))
    # Each step is seen from a camera turned by 0, 3, 3 degrees: a step of length 1 is off by 2 sin(angle / 2).
    assert errors.rte == pytest.approx(np.sqrt(2 / 3) * 2 * np.sin(np.radians(1.5)))


@pytest.mark.parametrize(
    ("predicted", "truth", "sentence"),
    [
        (still(2), still(2), "2 poses; expected at least 3"),
        (still(4), cameras(np.eye(4, 3)), "predicted cameras do not move"),
        (cameras(np.eye(4, 3)), still(4) + 0, "true cameras do not move"),
        (still(4), still(5), "4 predicted poses and 5 true ones"),
        (np.zeros((4, 4, 4)), still(4), r"expected \[S, 3, 4\]"),
        (np.zeros((4, 3, 4)), still(4), "frame 0 is not a rotation"),
        (-still(4), still(4), "frame 0 is not a rotation"),
        (np.full((4, 3, 4), np.inf), still(4), "not finite"),
    ],
)
def test_degenerate_trajectories_are_one_sentence(predicted, truth, sentence):
    with pytest.raises(InputError, match=sentence):
        centre_error(predicted, truth)


def test_one_pose_has_no_rotation_error():
    with pytest.raises(InputError, match="1 poses; expected at least 2"):
        rotation_error(still(1), still(1))


def test_single_precision_does_not_count_as_motion():
    generator = np.random.default_rng(2)
    turning_in_place = cameras(np.tile([3.0, -1, 4], (9, 1)), Rotation.random(9, rng=generator)).astype(np.float32)
    with pytest.raises(InputError, match="predicted cameras do not move"):
        centre_error(turning_in_place, random_cameras(generator, 9))


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


def test_trajectory_errors_by_hand():
    truth = cameras([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    pulled = cameras([[2, 0, 0], [-2, 0, 0], [0, 1, 0], [0, -1, 0]])
    predicted, truth = world_from(pulled), world_from(truth)
    # The best scale is 0.6: centres at +-1.2 and +-0.6 instead of +-1, errors 0.2, 0.2, 0.4, 0.4. Steps: (-2.4, 0),
    # (1.2, 0.6), (0, -1.2) instead of (-2, 0), (1, 1), (0, -2).
    scaled = trajectory_errors(predicted, truth)
    assert scaled.ate == pytest.approx(np.sqrt((2 * 0.04 + 2 * 0.16) / 4))
    assert scaled.rte == pytest.approx(np.sqrt((0.16 + 0.04 + 0.16 + 0.64) / 3))
    assert scaled.rre == pytest.approx(0, abs=1e-9)
    # Without scale nothing moves: errors 1, 1, 0, 0 and (-2, 0), (1, 0), (0, 0).
    rigid = trajectory_errors(predicted, truth, "se3")
    assert rigid[:2] == pytest.approx((np.sqrt(1 / 2), np.sqrt(5 / 3)))
    # From the first pose on: the prediction moves by -1 along x; errors 0, 2, 1, 1.
    first = trajectory_errors(predicted, truth, "first")
    assert first[:2] == pytest.approx((np.sqrt(6 / 4), np.sqrt(5 / 3)))


def test_the_first_pose_is_made_equal_by_a_rotation_too():
    """All cameras are turned by a quarter about z; the second also by 8 degrees about its own axis."""
    truth = world_from(cameras([[0, 0, 0], [1, 0, 0]], about(2, [0, 0])))
    quarter = np.eye(4)
    quarter[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    quarter[:3, 3] = 5, 6, 7
    predicted = quarter @ world_from(cameras([[0, 0, 0], [1, 0.5, 0]], about(2, [0, 8])))
    errors = trajectory_errors(predicted, truth, "first")
    assert errors == pytest.approx((np.sqrt(0.25 / 2), 0.5, 8))


def test_rotation_errors_in_degrees_by_hand():
    points = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]]
    predicted = world_from(cameras(points, about(2, [0, 3, 3, 7])))
    errors = trajectory_errors(predicted, world_from(cameras(points)))
    assert errors.rre == pytest.approx(np.sqrt((9 + 0 + 16) / 3))
    assert errors.ate == pytest.approx(0, abs=1e-9)
    assert errors.rte == pytest.approx(np.sqrt(2 / 3) * 2 * np.sin(np.radians(1.5)))


@settings(max_examples=30)
@given(seed=seeds)
def test_the_world_of_the_prediction_does_not_matter(seed):
    generator = np.random.default_rng(seed)
    predicted, truth = wandering(generator)
    errors = trajectory_errors(predicted, truth)
    camera_from_world = np.linalg.inv(predicted)[:, :3]
    moved = world_from(align(camera_from_world, random_similarity(generator)))
    assert trajectory_errors(moved, truth) == pytest.approx(errors)
    rigid = random_similarity(generator)._replace(scale=1.0)
    moved = world_from(align(camera_from_world, rigid))
    for how in ("se3", "first"):
        assert trajectory_errors(moved, truth, how) == pytest.approx(trajectory_errors(predicted, truth, how))
        assert trajectory_errors(truth, truth, how) == pytest.approx((0, 0, 0), abs=1e-5)
    assert trajectory_errors(truth, truth) == pytest.approx((0, 0, 0), abs=1e-5)
    assert errors.ate <= trajectory_errors(predicted, truth, "se3").ate + 1e-12
    assert errors.ate == pytest.approx(centre_error(camera_from_world, np.linalg.inv(truth)[:, :3]))


@pytest.mark.parametrize("how", ["sim3", "se3", "first"])
@pytest.mark.parametrize("seed", range(4))
def test_evo_agrees(seed, how):
    """An independent program (Grupp 2017): APE and RPE of the translation, RPE of the angle, RMSE, one frame apart."""
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is a test-only cross-check")
    trajectory = pytest.importorskip("evo.core.trajectory", reason="evo is a test-only cross-check")
    predicted, truth = wandering(np.random.default_rng(seed), noise=0.1)
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
    assert trajectory_errors(predicted, truth, how) == pytest.approx(tuple(wanted), abs=1e-6, rel=1e-6)


MANY, FEW, STILL = (world_from(poses) for poses in (cameras(np.eye(4, 3)), still(2), still(4)))


@pytest.mark.parametrize(
    ("predicted", "truth", "how", "sentence"),
    [
        (FEW, FEW, "sim3", "2 poses; expected at least 3"),
        (FEW[:1], FEW[:1], "first", "1 poses; expected at least 2"),
        (STILL, MANY, "sim3", "predicted cameras do not move"),
        (MANY, STILL, "se3", "true cameras do not move"),
        (MANY, FEW, "first", "4 predicted poses and 2 true ones"),
        (MANY, MANY, "sim2", "align is 'sim2'; expected one of sim3, se3, first"),
        (MANY[:, :3], MANY, "sim3", r"predicted poses have shape \(4, 3, 4\); expected world-from-camera \[S, 4, 4\]"),
        (MANY, 2 * MANY, "sim3", "true poses are not rigid"),
        (np.diag([2, 2, 2, 1]) * MANY, MANY, "sim3", "frame 0 is not a rotation"),
        (np.full((4, 4, 4), np.nan), MANY, "sim3", "predicted poses are not rigid"),
        (np.where(np.arange(4)[:, None] < 3, np.nan, MANY), MANY, "sim3", "not finite"),
    ],
)
def test_trajectories_that_cannot_be_compared_are_one_sentence(predicted, truth, how, sentence):
    with pytest.raises(InputError, match=sentence):
        trajectory_errors(predicted, truth, how)


def test_cameras_that_stand_still_have_errors_from_the_first_pose_on():
    assert trajectory_errors(STILL, STILL, "first") == (0, 0, 0)


def test_associate_by_hand():
    # 1.00 could go with 1.015 and 0.99; the closer wins, and 1.015 goes with 1.03. Nothing is near 5.
    assert associate(np.array([1.0, 1.03, 5]), np.array([0.99, 1.015])).tolist() == [[0, 0], [1, 1]]
    # Unsorted; the pair at 2 is exact, so 2.01 stays alone.
    assert associate(np.array([3, 2.01, 2]), np.array([2, 3.005])).tolist() == [[2, 0], [0, 1]]
    # Closest first: 0.001 takes 0, and its neighbour is left the farther one.
    assert associate(np.array([-0.012, 0.001]), np.array([0, 0.012])).tolist() == [[1, 0]]
    assert associate(np.array([0.0]), np.array([0.5]), 0.5).shape == (0, 2)  # exactly as far apart
    assert associate(np.array([]), np.array([1.0])).shape == (0, 2)


@settings(max_examples=60)
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


@pytest.mark.parametrize(
    ("times", "other", "tolerance", "sentence"),
    [
        (np.zeros((2, 2)), np.zeros(2), 0.02, "times has shape"),
        (np.zeros(2), np.array([np.nan]), 0.02, "other_times has shape"),
        (np.zeros(2), np.zeros(2), 0.0, "tolerance is 0.0"),
        (np.zeros(5000), np.zeros(5000), 0.02, "25000000 pairs of times"),
    ],
)
def test_times_that_cannot_be_paired_are_one_sentence(times, other, tolerance, sentence):
    with pytest.raises(InputError, match=sentence):
        associate(times, other, tolerance)
