"""Depth of a frame and of a sequence: hand-computed values, other optimisers on the same objectives."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.depth import depth_alignment, depth_errors, median_scale, video_depth_errors

TRUTH = np.array([[[2.0, 4.0]], [[8.0, 0.0]]])  # two frames of two pixels; the last is not measured
FRAME = TRUTH.reshape(1, 2, 2)


def depths(seed, shape) -> tuple[np.ndarray, np.ndarray]:
    """A prediction off by scale, shift and heavy-tailed noise, and a truth with holes."""
    generator = np.random.default_rng(seed)
    truth = np.exp(0.5 * generator.normal(size=shape)) + 1
    noise = np.clip(0.1 * generator.standard_t(2, size=shape), -0.9, 3)
    predicted = np.maximum((truth * (1 + noise) + 0.5) * np.exp(generator.normal()), 0.01)
    return predicted, np.where(generator.random(shape) < 0.2, 0, truth)


def test_errors_by_hand():
    predicted = np.array([[[2.0, 5.0]], [[4.0, np.nan]]])
    errors = video_depth_errors(predicted, TRUTH, "metric")
    assert errors.abs_rel == pytest.approx((0 + 0.25 + 0.5) / 3)
    assert errors.rmse == pytest.approx(np.sqrt((0 + 1 + 16) / 3))
    assert errors.delta1 == pytest.approx(1 / 3)  # 5 / 4 is not below 1.25
    assert errors.delta2 == pytest.approx(2 / 3)
    assert errors.delta3 == pytest.approx(2 / 3)  # 1.25^3 is 1.953: 2 is above
    assert errors.pixels == 3
    assert video_depth_errors(1.03 * predicted, TRUTH, "metric").delta3 == 1
    near = video_depth_errors(predicted, TRUTH, "metric", max_depth=8)
    assert near == pytest.approx((0.125, np.sqrt(0.5), 0.5, 1, 1, 2))


def test_alignments_by_hand():
    predicted = np.array([[[1.0, 2.0]], [[6.0, 1.0]]])
    # Medians 2 and 4: scale 2, so 2, 4, 12.
    assert video_depth_errors(predicted, TRUTH, "median").abs_rel == pytest.approx(0.5 / 3)
    assert depth_alignment(predicted, TRUTH, "median") == (2, 0)
    assert depth_alignment(predicted, TRUTH, "metric") == (1, 0)
    # |s - 2| + |2 s - 4| + |6 s - 8| is least at 4 / 3, where the deepest is exact; the rest is 4 / 3 and 8 / 3.
    scaled = video_depth_errors(predicted, TRUTH, "scale")
    assert depth_alignment(predicted, TRUTH) == pytest.approx((4 / 3, 0), rel=1e-3)
    assert scaled.abs_rel == pytest.approx(2 / 9, rel=1e-3)
    assert scaled.rmse == pytest.approx(np.sqrt((4 / 9 + 16 / 9) / 3), rel=1e-3)
    # Two pixels of depth 1, of which the truth is 1 and 3: the start, mean over mean, is where all rounds stay.
    assert depth_alignment(np.ones(2), np.array([1.0, 3.0])).scale == pytest.approx(2)


@pytest.mark.parametrize("seed", range(3))
def test_the_least_absolute_scale_is_the_optimum_and_ten_rounds_need_not_be(seed):
    predicted, truth = depths(seed, (2, 14, 14))
    g, d = truth[truth > 0], predicted[truth > 0]
    found = depth_alignment(predicted, truth, "least-absolute")
    every = np.abs((g / d)[:, None] * d - g).sum(axis=1)  # the least sum is where a pixel is exact
    assert found == pytest.approx(((g / d)[every.argmin()], 0), rel=1e-12)
    assert np.abs(found.scale * d - g).sum() <= np.abs(depth_alignment(predicted, truth).scale * d - g).sum()


def test_ten_rounds_stop_before_the_optimum():
    d, g = np.ones(11), np.repeat([1.0, 20.0], [6, 5])  # |s - 1| of six pixels and |s - 20| of five: least at 1
    assert depth_alignment(d, g, "least-absolute") == (1, 0)
    assert depth_alignment(d, g).scale > 2  # from the mean, 9.6
    # The ratios 3, 3.1, 3.2 and 0.1 have the weights 1, 1, 1 and 10: one deep pixel is over half.
    d, g = np.array([1.0, 1.0, 1.0, 10.0]), np.array([3.0, 3.1, 3.2, 1.0])
    assert depth_alignment(d, g, "least-absolute") == (0.1, 0)
    with pytest.raises(InputError, match="the predicted depth is 0 in all valid pixels"):
        depth_alignment(np.zeros(2), np.ones(2), "least-absolute")


def test_a_depth_behind_the_camera_is_close_to_nothing():
    errors = video_depth_errors(np.array([[[-3.0, 0.0, 2.0]]]), np.full((1, 1, 3), 2.0), "metric")
    assert errors[2:] == pytest.approx((1 / 3, 1 / 3, 1 / 3, 3))
    assert errors.abs_rel == pytest.approx((2.5 + 1 + 0) / 3)


@pytest.mark.parametrize("seed", range(2))
def test_scale_and_shift_have_the_least_absolute_error_of_a_linear_program(seed):
    predicted, truth = depths(seed, (2, 14, 14))
    g, d = truth[truth > 0], predicted[truth > 0]
    lines, slack = np.stack([d, np.ones_like(d)], axis=1), np.eye(len(d))
    program = linprog(
        np.r_[0, 0, np.ones_like(d)],
        A_ub=np.block([[lines, -slack], [-lines, -slack]]),
        b_ub=np.r_[g, -g],
        bounds=[(None, None)] * 2 + [(0, None)] * len(d),
    )
    scale, shift = program.x[:2]
    exact = video_depth_errors(scale * predicted + shift, truth, "metric")
    found = video_depth_errors(predicted, truth, "scale-shift")
    assert found.abs_rel == pytest.approx(exact.abs_rel, rel=2e-3)
    assert found.rmse == pytest.approx(exact.rmse, rel=2e-3)


def test_depth_that_cannot_be_compared_is_one_sentence():
    cases: Any = (
        (np.ones((2, 1, 3)), TRUTH, {}, "resize the prediction first"),
        (-np.ones((2, 1, 2)), TRUTH, {}, "the mean of the predicted depth is -1; expected it above 0"),
    )
    for predicted, truth, options, sentence in cases:
        with pytest.raises(InputError, match=sentence):
            video_depth_errors(predicted, truth, **options)


def test_depth_of_a_frame_by_hand():
    predicted = np.array([[[1.0, 2.0], [5.0, 9.0]]])
    assert median_scale(predicted, FRAME) == 2  # of 2, 2 and 1.6
    errors = depth_errors(predicted, FRAME)  # 2, 4 and 10 against 2, 4 and 8
    assert errors.abs_rel == pytest.approx(0.25 / 3)
    assert errors.delta1 == pytest.approx(2 / 3)  # 10 / 8 is not below 1.25
    valid = np.array([[[True, False], [True, True]]])
    assert depth_errors(np.array([[[1.0, np.nan], [4.0, -1.0]]]), FRAME, valid) == (0, 1)  # only valid pixels count
    assert depth_errors(predicted, FRAME, scale=1.0).abs_rel == pytest.approx((0.5 + 0.5 + 0.375) / 3)
    assert depth_errors(predicted, FRAME, scale=1.61).delta1 == pytest.approx(3 / 3)


def test_depth_of_a_frame_that_cannot_be_compared_is_one_sentence():
    for predicted, valid, sentence in (
        (np.ones((1, 2, 3)), None, "expected the same"),
        (np.array([[[1.0, np.inf], [0.0, 1.0]]]), None, "2 predicted depths are not finite and above 0"),
        (np.ones((1, 2, 2)), np.zeros((1, 2, 2), bool), "no pixel has a true depth"),
    ):
        with pytest.raises(InputError, match=sentence):
            depth_errors(predicted, FRAME, valid)
