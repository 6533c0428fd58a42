"""Depth up to scale: hand-computed values, invariance to scale, and the mean depth map."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.depth import depth_errors, measured, median_scale

TRUTH = np.array([[[2.0, 4.0], [8.0, 0.0]]])  # one frame; the last pixel is not measured


def test_by_hand():
    predicted = np.array([[[1.0, 2.0], [5.0, 9.0]]])
    assert median_scale(predicted, TRUTH) == 2  # of 2, 2 and 1.6
    errors = depth_errors(predicted, TRUTH)  # 2, 4 and 10 against 2, 4 and 8
    assert errors.abs_rel == pytest.approx(0.25 / 3)
    assert errors.delta1 == pytest.approx(2 / 3)  # 10 / 8 is not below 1.25
    assert depth_errors(predicted, TRUTH, scale=1.0).abs_rel == pytest.approx((0.5 + 0.5 + 0.375) / 3)
    assert depth_errors(predicted, TRUTH, scale=1.61).delta1 == pytest.approx(3 / 3)


def test_only_valid_pixels_count():
    predicted = np.array([[[1.0, np.nan], [4.0, -1.0]]])
    valid = np.array([[[True, False], [True, True]]])
    assert median_scale(np.where(valid, predicted, 1), np.where(valid, TRUTH, 0)) == 2
    assert depth_errors(predicted, TRUTH, valid) == (0, 1)
    assert measured(np.array([0, -1, np.nan, np.inf, 3])).tolist() == [False, False, False, False, True]


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-3, 1e3))
def test_scale_does_not_matter(seed, scale):
    generator = np.random.default_rng(seed)
    truth, predicted = np.exp(generator.normal(size=(2, 3, 4, 5)))
    errors, scaled = depth_errors(predicted, truth), depth_errors(scale * predicted, truth)
    assert errors.abs_rel == pytest.approx(scaled.abs_rel)
    assert median_scale(scale * predicted, truth) * scale == pytest.approx(median_scale(predicted, truth))
    assert depth_errors(scale * truth, truth).abs_rel == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("predicted", "valid", "sentence"),
    [
        (np.ones((1, 2, 3)), None, "expected the same"),
        (np.array([[[1.0, np.inf], [0.0, 1.0]]]), None, "2 predicted depths are not finite and above 0"),
        (np.ones((1, 2, 2)), np.zeros((1, 2, 2), bool), "no pixel has a true depth"),
        (np.ones((1, 2, 2)), np.ones((1, 2, 2)), "of bool"),
    ],
)
def test_bad_input_is_one_sentence(predicted, valid, sentence):
    with pytest.raises(InputError, match=sentence):
        depth_errors(predicted, TRUTH, valid)
    if valid is None:
        with pytest.raises(InputError, match=sentence):
            median_scale(predicted, TRUTH)
