"""Point clouds against the truth: hand-computed values, properties, and another library's nearest neighbours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sklearn.neighbors import NearestNeighbors

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics import point_clouds
from vggtjax.evaluation.metrics.point_clouds import (
    nearest_distances,
    normals_of,
    paired_distance,
    point_cloud_errors,
    statistics,
)

TRUTH = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])
PREDICTED = np.array([[0, 0, 1], [0, 3, 4], [2, 0, 0], [2, 0, 0.5]])

seeds = st.integers(0, 2**32 - 1)


def clouds(seed, counts=(40, 50), kind=np.float64):
    generator = np.random.default_rng(seed)
    return [generator.normal(size=(count, 3)).astype(kind) for count in counts]


def unit_vectors(generator, count) -> np.ndarray:
    vectors = generator.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_accuracy_completeness_and_distance_by_hand():
    errors = point_cloud_errors(PREDICTED, TRUTH)
    assert errors.accuracy == pytest.approx(((1 + 5 + 0 + 0.5) / 4, 0.75))  # median of 0, 0.5, 1, 5
    assert errors.completeness == pytest.approx(((1 + 1 + 0) / 3, 1))  # (1, 0, 0) is nearest to (2, 0, 0)
    assert errors.distance_chamfer == pytest.approx((np.mean([errors.accuracy[0], errors.completeness[0]]), 0.875))
    assert errors.normal_consistency is None


def test_the_distances_behind_accuracy_by_hand(monkeypatch):
    monkeypatch.setattr(point_clouds, "_CHUNK", 3)
    told = []
    distances = nearest_distances(PREDICTED, TRUTH, progress=lambda *done: told.append(done))
    assert distances.tolist() == [1, 5, 0, 0.5]
    assert told == [(3, 4), (4, 4)]
    assert statistics(distances) == (1.625, 0.75)
    assert distances.tolist() == [1, 5, 0, 0.5]
    with pytest.raises(InputError, match="no distances"):
        statistics(distances[:0])
    with pytest.raises(InputError, match="second cloud has no points"):
        nearest_distances(TRUTH, TRUTH[:0])


def test_normal_consistency_by_hand():
    tilted = np.array([[0, 0.6, 0.8], [1, 0, 0], [0, 0, -1], [np.nan, np.nan, np.nan]])
    upwards = np.array([[0, 0, 1.0], [0, 1, 0], [0, 0, 1]])
    errors = point_cloud_errors(PREDICTED, TRUTH, normals=(tilted, upwards))
    # Prediction to truth: neighbours 0, 0, 2 and 2: 0.8, 0 and 1; the last has no normal. Truth to prediction:
    # neighbours 0, 2 and 2: 0.8, 0 and 1.
    assert errors.normal_consistency == pytest.approx(0.6)
    reversed_errors = point_cloud_errors(PREDICTED, TRUTH, normals=(-tilted, upwards))
    assert reversed_errors.normal_consistency == pytest.approx(0.6)


def test_the_two_directions_of_normals_weigh_alike():
    predicted, truth = np.zeros((1, 3)), np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])
    normals = np.array([[0, 0, 1.0]]), np.array([[0, 0, 1.0], [0, 1, 0], [0, 1, 0]])
    errors = point_cloud_errors(predicted, truth, normals=normals)
    assert errors.normal_consistency == pytest.approx((1 + 1 / 3) / 2)


def test_paired_distance_by_hand():
    assert paired_distance(PREDICTED[:3], TRUTH) == pytest.approx(((1 + np.sqrt(26) + 0) / 3, 1))
    assert paired_distance(TRUTH, TRUTH) == (0, 0)


@settings(max_examples=40)
@given(seed=seeds, count=st.integers(1, 60), other=st.integers(1, 60))
def test_swapping_the_clouds_swaps_accuracy_and_completeness(seed, count, other):
    predicted, truth = clouds(seed, (count, other))
    generator = np.random.default_rng(seed)
    normals = unit_vectors(generator, count), unit_vectors(generator, other)
    errors = point_cloud_errors(predicted, truth, normals=normals)
    swapped = point_cloud_errors(truth, predicted, normals=(normals[1], normals[0]))
    assert errors.accuracy == swapped.completeness
    assert errors.completeness == swapped.accuracy
    assert errors.distance_chamfer == pytest.approx(swapped.distance_chamfer)
    assert errors.normal_consistency == pytest.approx(swapped.normal_consistency)
    same = point_cloud_errors(truth, truth, normals=(normals[1], -normals[1]))
    assert (*same.accuracy, *same.completeness, *same.distance_chamfer) == (0,) * 6
    assert same.normal_consistency == pytest.approx(1)


@settings(max_examples=40)
@given(seed=seeds, noise=st.floats(1e-3, 10))
def test_a_paired_point_is_never_nearer_than_the_nearest(seed, noise):
    truth, offsets = clouds(seed, (30, 30))
    predicted = truth + noise * offsets
    errors, paired = point_cloud_errors(predicted, truth), paired_distance(predicted, truth)
    assert paired.mean >= max(errors.accuracy.mean, errors.completeness.mean) - 1e-12
    assert paired.median >= max(errors.accuracy.median, errors.completeness.median) - 1e-12


@settings(max_examples=20)
@given(seed=seeds, scale=st.floats(0.01, 100))
def test_a_common_motion_does_nothing_and_a_common_scale_scales(seed, scale):
    predicted, truth = clouds(seed)
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    errors = point_cloud_errors(predicted, truth)
    moved = point_cloud_errors(*(scale * rotation.apply(points) + [3, -4, 5] for points in (predicted, truth)))
    for one, other in zip(errors[:3], moved[:3], strict=True):
        assert other == pytest.approx([scale * value for value in one])


@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize("seed", range(3))
def test_another_librarys_neighbours_give_the_same(monkeypatch, seed, kind):
    monkeypatch.setattr(point_clouds, "_CHUNK", 170)  # several chunks, the last one not full
    predicted, truth = clouds(seed, (700, 900), kind)
    truth[100:400] = truth[:300]  # points that coincide
    generator = np.random.default_rng(seed)
    normals = unit_vectors(generator, 700), unit_vectors(generator, 900)
    normals[1][100:400] = normals[1][:300]
    told = []
    errors = point_cloud_errors(predicted, truth, normals=normals, progress=lambda *done: told.append(done))
    consistency = []
    for source, target, ours, theirs, found in (
        (predicted, truth, *normals, errors.accuracy),
        (truth, predicted, *normals[::-1], errors.completeness),
    ):
        distances, nearest = NearestNeighbors(n_neighbors=1, algorithm="brute").fit(target).kneighbors(source)
        assert found == pytest.approx((distances.mean(), np.median(distances)), rel=1e-4)
        exact = np.linalg.norm(source.astype(float)[:, None] - target.astype(float)[None], axis=2).min(axis=1)
        assert found == pytest.approx((exact.mean(), np.median(exact)), rel=1e-12)
        consistency.append(np.abs((ours * theirs[nearest[:, 0]]).sum(axis=1)).mean())
    assert errors.normal_consistency == pytest.approx(np.mean(consistency))
    assert told[:2] == [(170, 1600), (340, 1600)]
    assert told[-1] == (1600, 1600)
    assert sorted(told) == told


def test_single_precision_far_from_the_origin_is_searched_exactly():
    truth = np.array([[1000, 0, 0], [1000.001, 0, 0]], np.float32)
    predicted = np.array([[1000.0004, 0, 0]], np.float32)
    exact = np.abs(truth[:, 0].astype(float) - float(predicted[0, 0]))
    assert point_cloud_errors(predicted, truth).accuracy.mean == pytest.approx(exact.min(), rel=1e-12)


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_normals_of_a_plane_by_hand(kind):
    rows, columns = np.mgrid[:4, :5]
    plane = np.stack([columns, rows, 2 * columns], axis=-1)[None].astype(kind)  # z = 2 x
    normals = normals_of(plane)
    assert normals.dtype == kind
    inside = normals[0, 1:-1, 1:-1]
    # (2, 0, 4) x (0, 2, 0) = (-8, 0, 4)
    assert inside == pytest.approx(np.broadcast_to(np.array([-2, 0, 1]) / np.sqrt(5), inside.shape))
    for border in (normals[0, 0], normals[0, -1], normals[0, :, 0], normals[0, :, -1]):
        assert np.isnan(border).all()


def test_normals_of_a_sphere_point_away_from_its_centre():
    longitude, latitude = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 31))
    ball = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], axis=-1
    )
    normals = normals_of(np.stack([ball, 3 * ball]))
    cosine = (normals * ball).sum(axis=-1)[:, 1:-1, 1:-1]
    assert cosine == pytest.approx(1, abs=1e-12)


def test_normals_are_undefined_next_to_holes_and_on_lines():
    rows, columns = np.mgrid[:7, :7]
    flat = np.stack([columns, rows, 0 * rows], axis=-1).astype(float)
    flat[3, 3] = np.inf
    defined = np.isfinite(normals_of(flat[None])[0, 1:-1, 1:-1]).all(axis=-1)
    hole = np.ones((5, 5), bool)
    for row, column in ((1, 2), (3, 2), (2, 1), (2, 3)):
        hole[row, column] = False
    assert defined.tolist() == hole.tolist()
    line = np.stack([columns, columns, columns], axis=-1)[None]
    assert np.isnan(normals_of(line)).all()
    assert np.isnan(normals_of(flat[None, :2])).all()
    assert normals_of(np.empty((0, 4, 4, 3))).shape == (0, 4, 4, 3)


@pytest.mark.parametrize(
    ("predicted", "truth", "sentence"),
    [
        (TRUTH[:0], TRUTH, "predicted cloud has no points"),
        (TRUTH, TRUTH[:0], "true cloud has no points"),
        (TRUTH[:, :2], TRUTH, r"predicted points have shape \(3, 2\); expected \[N, 3\]"),
        (TRUTH[None], TRUTH, r"expected \[N, 3\]"),
        (TRUTH, np.array([[0, 0, np.nan], [1, 1, 1]]), "1 of 2 true points are not finite"),
    ],
)
def test_clouds_that_cannot_be_compared_are_one_sentence(predicted, truth, sentence):
    for function in (point_cloud_errors, paired_distance):
        with pytest.raises(InputError, match=sentence):
            function(predicted, truth)


@pytest.mark.parametrize(
    ("normals", "sentence"),
    [
        ((np.ones((2, 3)), np.ones((3, 3))), r"predicted normals have shape \(2, 3\); expected \(3, 3\)"),
        ((np.eye(3), np.diag([1, 1, 2.0])), "true normal of point 2 has length 2; expected 1"),
        ((np.eye(3), np.zeros((3, 3))), "true normal of point 0 has length 0"),
        ((np.eye(3), np.full((3, 3), np.nan)), "no nearest neighbours both have a normal"),
    ],
)
def test_normals_that_cannot_be_compared_are_one_sentence(normals, sentence):
    with pytest.raises(InputError, match=sentence):
        point_cloud_errors(TRUTH, TRUTH, normals=normals)


def test_points_without_partners_have_no_paired_distance():
    with pytest.raises(InputError, match="4 predicted points and 3 true ones; expected pairs"):
        paired_distance(PREDICTED, TRUTH)


def test_points_that_are_no_image_have_no_normals():
    with pytest.raises(InputError, match=r"shape \(3, 3\); expected one for each pixel"):
        normals_of(TRUTH)
