import numpy as np
import pytest

from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.point_clouds import normals_of, paired_distance, point_cloud_errors

LONG = np.diag([1, 1, 2.0])
TRUTH = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])
PREDICTED = np.array([[0, 0, 1], [0, 3, 4], [2, 0, 0], [2, 0, 0.5]])


def test_accuracy_completeness_and_distance_by_hand():
    errors = point_cloud_errors(PREDICTED, TRUTH)
    assert errors.accuracy == pytest.approx(((1 + 5 + 0 + 0.5) / 4, 0.75))  # median of 0, 0.5, 1, 5
    assert errors.completeness == pytest.approx(((1 + 1 + 0) / 3, 1))  # (1, 0, 0) is nearest to (2, 0, 0)
    assert errors.distance_chamfer == pytest.approx((np.mean([errors.accuracy[0], errors.completeness[0]]), 0.875))
    assert errors.normal_consistency is None
    assert paired_distance(PREDICTED[:3], TRUTH) == pytest.approx(((1 + np.sqrt(26) + 0) / 3, 1))


def test_normal_consistency_by_hand():
    tilted = np.array([[0, 0.6, 0.8], [1, 0, 0], [0, 0, -1], [np.nan, np.nan, np.nan]])
    upwards = np.array([[0, 0, 1.0], [0, 1, 0], [0, 0, 1]])
    errors = point_cloud_errors(PREDICTED, TRUTH, normals=(tilted, upwards))
    # Prediction to truth: neighbours 0, 0, 2 and 2: 0.8, 0 and 1; the last has no normal. Truth to prediction:
    # neighbours 0, 2 and 2: 0.8, 0 and 1.
    assert errors.normal_consistency == pytest.approx(0.6)
    normals = np.array([[0, 0, -1.0]]), np.array([[0, 0, 1.0], [0, 1, 0], [0, 1, 0]])
    errors = point_cloud_errors(np.zeros((1, 3)), TRUTH, normals=normals)
    assert errors.normal_consistency == pytest.approx((1 + 1 / 3) / 2)  # the two directions weigh alike


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
    ("call", "sentence"),
    [
        (lambda: paired_distance(PREDICTED, TRUTH), "4 predicted points and 3 true ones; expected pairs"),
        (lambda: normals_of(TRUTH), r"shape \(3, 3\); expected one for each pixel"),
        (
            lambda: point_cloud_errors(TRUTH, TRUTH, normals=(LONG, np.eye(3))),
            "normal of point 2 has length 2",
        ),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()
