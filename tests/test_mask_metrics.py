"""Saliency and masks: hand-computed values and properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggtjax.errors import InputError
from vggtjax.evaluation.masks import auc, jaccard, precision_recall

NONE, SOME, MORE = (np.array(bits, bool).reshape(1, 2, 2) for bits in ([0, 0, 0, 0], [1, 0, 1, 0], [1, 1, 0, 0]))


def test_auc_by_hand():
    mask = np.array([False, False, True, True])
    assert auc(np.array([0.1, 0.4, 0.35, 0.8]), mask) == 0.75
    assert auc(np.array([0, 1, 1, 1]), mask) == 0.75  # two ties of four pairs, one of them halves
    assert auc(np.zeros(4), mask) == 0.5
    assert auc(mask.astype(float), mask) == 1
    assert auc(-mask.astype(float), mask) == 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), levels=st.integers(1, 30))
def test_auc_is_the_share_of_pairs(seed, levels):
    generator = np.random.default_rng(seed)
    saliency = generator.integers(0, levels, (3, 4, 5)) / levels
    mask = generator.random((3, 4, 5)) < 0.3
    mask[0, 0, :2] = True, False
    inside, outside = saliency[mask][:, None], saliency[~mask][None]
    pairs = (inside > outside) + 0.5 * (inside == outside)
    assert auc(saliency, mask) == pytest.approx(pairs.mean())
    assert auc(np.exp(3 * saliency), mask) == pytest.approx(auc(saliency, mask))  # ranks alone count
    assert auc(saliency, ~mask) == pytest.approx(1 - auc(saliency, mask))


@pytest.mark.parametrize(
    ("saliency", "mask", "sentence"),
    [
        (np.zeros((1, 2, 2)), NONE, "0 dynamic and 4 static"),
        (np.zeros((1, 2, 2)), ~NONE, "4 dynamic and 0 static"),
        (np.full((1, 2, 2), np.nan), SOME, "not finite"),
        (np.zeros((2, 2)), SOME, "expected the same"),
        (np.zeros((1, 2, 2)), SOME.astype(int), "expected bool"),
    ],
)
def test_auc_of_bad_input_is_one_sentence(saliency, mask, sentence):
    with pytest.raises(InputError, match=sentence):
        auc(saliency, mask)


def test_jaccard_precision_and_recall_by_hand():
    assert jaccard(SOME, MORE) == pytest.approx(1 / 3)
    assert jaccard(SOME, SOME) == 1
    assert jaccard(NONE, SOME) == 0
    assert jaccard(NONE, NONE) == 1
    everything = ~NONE
    assert precision_recall(everything, SOME) == (0.5, 1)
    assert precision_recall(SOME, everything) == (1, 0.5)
    assert precision_recall(NONE, SOME) == (1, 0)
    assert precision_recall(SOME, NONE) == (0, 1)


@pytest.mark.parametrize("function", [jaccard, precision_recall])
def test_masks_that_do_not_fit_are_one_sentence(function):
    with pytest.raises(InputError, match=r"has shape \(2, 2\) and the true one \(1, 2, 2\)"):
        function(SOME[0], SOME)
    with pytest.raises(InputError, match="expected bool"):
        function(SOME.astype(np.uint8), SOME)
