"""Depth up to scale: hand-computed values, invariance to scale, and the mean depth map."""

import numpy as np
import pytest

from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.depth import depth_errors, median_scale

TRUTH = np.array([[[2.0, 4.0], [8.0, 0.0]]])  # one frame; the last pixel is not measured


def test_by_hand():
    predicted = np.array([[[1.0, 2.0], [5.0, 9.0]]])
    assert median_scale(predicted, TRUTH) == 2  # of 2, 2 and 1.6
    errors = depth_errors(predicted, TRUTH)  # 2, 4 and 10 against 2, 4 and 8
    assert errors.abs_rel == pytest.approx(0.25 / 3)
    assert errors.delta1 == pytest.approx(2 / 3)  # 10 / 8 is not below 1.25
    valid = np.array([[[True, False], [True, True]]])
    assert depth_errors(np.array([[[1.0, np.nan], [4.0, -1.0]]]), TRUTH, valid) == (0, 1)  # only valid pixels count
    assert depth_errors(predicted, TRUTH, scale=1.0).abs_rel == pytest.approx((0.5 + 0.5 + 0.375) / 3)
    assert depth_errors(predicted, TRUTH, scale=1.61).delta1 == pytest.approx(3 / 3)


def test_bad_input_is_one_sentence():
    for predicted, valid, sentence in (
        (np.ones((1, 2, 3)), None, "expected the same"),
        (np.array([[[1.0, np.inf], [0.0, 1.0]]]), None, "2 predicted depths are not finite and above 0"),
        (np.ones((1, 2, 2)), np.zeros((1, 2, 2), bool), "no pixel has a true depth"),
    ):
        with pytest.raises(InputError, match=sentence):
            depth_errors(predicted, TRUTH, valid)
