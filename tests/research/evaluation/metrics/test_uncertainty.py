import numpy as np
import pytest

from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics import uncertainty
from vggtjax.research.evaluation.metrics.uncertainty import ause, calibration_error, uncertainty_scores


def test_sparsification_by_hand():
    errors, confidence = np.array([4.0, -1, 2, 1]), np.array([1, 4, 3, 2])
    curve = uncertainty.sparsification_curve(errors, confidence, steps=4)
    assert curve.fractions.tolist() == [0, 0.25, 0.5, 0.75]
    assert curve.remaining == pytest.approx([8 / 4, 4 / 3, 3 / 2, 1])  # without 4, then 1, then 2
    assert curve.oracle == pytest.approx([8 / 4, 4 / 3, 1, 1])  # without 4, then 2, then a 1
    tied = uncertainty.sparsification_curve(np.array([3.0, 1, 8, 4]), np.array([1, 1, 0, 2]), steps=4)
    assert tied.remaining == pytest.approx([4, 8 / 3, 3, 4])  # 8 goes first; then 2 and 2 for 3 and 1
    # Two steps more than there are pixels to take: shares of 1 / 8 of four pixels are rounded to the even half.
    curve = uncertainty.sparsification_curve(errors, confidence, steps=8)
    assert curve.remaining == pytest.approx([2, 2, 4 / 3, 3 / 2, 3 / 2, 3 / 2, 1, 1])


def test_ause_by_hand():
    """Twenty pixels, as many as steps; the confidence puts the only error last instead of first."""
    errors = np.zeros(20)
    errors[0] = 20
    confidence = np.r_[20, np.arange(19)]
    curve = uncertainty.sparsification_curve(errors, confidence)
    assert curve.remaining == pytest.approx(20 / np.arange(20, 0, -1))
    between = 20 / np.arange(20, 0, -1) - np.r_[1, np.zeros(19)]
    assert ause(errors, confidence) == pytest.approx((between.sum() - between[-1] / 2) / 20)
    assert ause(errors, -confidence) == 0
    assert ause(0 * errors, confidence) == 0


def test_likelihood_by_hand():
    errors, precision = np.array([1.0, -2, 3]), np.array([4.0, 1, 1])
    assert uncertainty_scores(9 + errors, np.full(3, 9.0), precision).scale == pytest.approx((4 + 4 + 9) / 3)
    by_hand = [(np.log(2 * np.pi / 4) + 4) / 2, (np.log(2 * np.pi) + 4) / 2, (np.log(2 * np.pi) + 9) / 2]
    assert uncertainty.gaussian_nll(errors, precision, 1.0) == pytest.approx(np.mean(by_hand))
    assert uncertainty.gaussian_nll(np.zeros(3), np.full(3, 2 * np.pi), 1.0) == pytest.approx(0)


def test_calibration_error_by_hand():
    # Levels 1/4 and 3/4: z is 0.3186 and 1.1503.
    errors = np.array([0.1, -0.3, 1.0, 5.0])
    curve = uncertainty.reliability_curve(errors, np.ones(4), bins=2)
    assert curve.levels.tolist() == [0.25, 0.75]
    assert curve.shares.tolist() == [0.5, 0.75]
    assert calibration_error(errors, np.ones(4), bins=2) == pytest.approx(0.125)
    # Sigma ten times as large: 3.186 and 11.503.
    assert uncertainty.reliability_curve(errors, np.full(4, 0.01), bins=2).shares.tolist() == [0.75, 1]
    assert uncertainty.reliability_curve(errors, np.full(4, 0.01), 0.01, bins=2).shares.tolist() == [0.5, 0.75]
    # Far too sure of itself: nothing is within, and the levels themselves are missed.
    assert calibration_error(errors, np.full(4, 1e12)) == pytest.approx(0.5)
    assert calibration_error(np.zeros(4), np.ones(4)) == pytest.approx(0.5)


def test_scores_by_hand_of_the_parts():
    generator = np.random.default_rng(3)
    precision = np.exp(generator.normal(size=400))
    errors = np.sqrt(5 / precision) * generator.normal(size=400)  # five times the variance that the precision claims
    truth = np.full(400, 50.0)
    truth[:30] = np.tile([0, np.nan, -1], 10)  # not measured
    predicted = np.where(np.arange(400) < 30, np.nan, truth + errors)
    scores = uncertainty_scores(predicted.reshape(4, 10, 10), truth.reshape(4, 10, 10), precision.reshape(4, 10, 10))
    errors, precision = errors[30:], precision[30:]
    assert scores.scale == pytest.approx((precision * errors**2).mean())
    assert scores.scale == pytest.approx(5, rel=0.3)
    assert scores.ause == pytest.approx(ause(errors, precision))
    assert scores.nll == pytest.approx(uncertainty.gaussian_nll(errors, precision, 1))
    assert scores.nll_calibrated == pytest.approx(uncertainty.gaussian_nll(errors, precision, scores.scale))
    assert scores.ece_calibrated == pytest.approx(calibration_error(errors, precision, scores.scale))


ONES = np.ones((1, 2, 2))


def test_depth_without_uncertainty_is_one_sentence():
    for predicted, truth, precision, sentence in (
        (ONES, ONES, ONES, "all errors are 0"),
        (ONES, ONES, ONES[0], r"shapes \(1, 2, 2\), \(1, 2, 2\) and \(2, 2\)"),
        (2 * ONES, ONES, 0 * ONES, "4 of 4 precisions are not above 0"),
    ):
        with pytest.raises(InputError, match=sentence):
            uncertainty_scores(predicted, truth, precision)
