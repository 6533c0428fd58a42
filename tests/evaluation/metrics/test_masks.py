"""Saliency and masks: hand-computed values and properties."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.masks import (
    auc,
    boundary,
    frame_scores,
    jaccard,
    mask_scores,
    pooled_scores,
)

NONE, SOME, MORE = (np.array(bits, bool).reshape(1, 2, 2) for bits in ([0, 0, 0, 0], [1, 0, 1, 0], [1, 1, 0, 0]))


def test_auc_by_hand():
    mask = np.array([False, False, True, True])
    assert auc(np.array([0.1, 0.4, 0.35, 0.8]), mask) == 0.75
    assert auc(np.array([0, 1, 1, 1]), mask) == 0.75  # two ties of four pairs, one of them halves
    assert auc(np.zeros(4), mask) == 0.5
    assert auc(mask.astype(float), mask) == 1
    assert auc(-mask.astype(float), mask) == 0


@settings(max_examples=60)
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


def test_jaccard_by_hand():
    assert jaccard(SOME, MORE) == pytest.approx(1 / 3)
    assert jaccard(SOME, SOME) == 1
    assert jaccard(NONE, SOME) == 0
    assert jaccard(NONE, NONE) == 1


def test_masks_that_do_not_fit_are_one_sentence():
    with pytest.raises(InputError, match=r"has shape \(2, 2\) and the true one \(1, 2, 2\)"):
        jaccard(SOME[0], SOME)
    with pytest.raises(InputError, match="expected bool"):
        jaccard(SOME.astype(np.uint8), SOME)


def rectangle(rows, columns, shape=(12, 16)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def test_boundary_by_hand():
    mask = np.array([[0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 1]], bool)
    drawn = [[1, 1, 1, 0], [1, 0, 1, 0], [1, 1, 1, 1], [0, 0, 1, 0]]
    assert boundary(mask).astype(int).tolist() == drawn
    assert not boundary(np.ones((3, 4), bool)).any()
    assert boundary(np.array([[1, 0]], bool)).tolist() == [[True, False]]
    assert boundary(np.array([[0], [1]], bool)).tolist() == [[True], [False]]


def slow_boundary_f(predicted, truth) -> float:
    """The boundary measure by plain loops over pixels: neighbours, then a disk drawn around every boundary pixel."""
    H, W = truth.shape
    radius = math.ceil(0.008 * math.sqrt(H * H + W * W))

    def edge(mask) -> set[tuple[int, int]]:
        found = set()
        for y in range(H):
            for x in range(W):
                right, below = x + 1 < W, y + 1 < H
                neighbours = [(y, x + 1)] * right + [(y + 1, x)] * below + [(y + 1, x + 1)] * (right and below)
                if any(mask[y, x] != mask[there] for there in neighbours):
                    found.add((y, x))
        return found

    def dilated(pixels) -> set[tuple[int, int]]:
        steps = range(-radius, radius + 1)
        disk = [(dy, dx) for dy in steps for dx in steps if dy * dy + dx * dx <= radius * radius]
        return {(y + dy, x + dx) for y, x in pixels for dy, dx in disk}

    found, sought = edge(predicted), edge(truth)
    if not found and not sought:
        return 1.0
    precision = len(found & dilated(sought)) / len(found) if found else 1.0
    recall = len(sought & dilated(found)) / len(sought) if sought else 1.0
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


@pytest.mark.parametrize("shape", [(9, 13), (30, 50), (80, 120), (1, 30)])  # disks of 1, 1, 2 and 1 pixels
@pytest.mark.parametrize("seed", range(4))
def test_boundaries_agree_with_the_slow_way(shape, seed):
    generator = np.random.default_rng(seed)
    H, W = shape
    y, x = np.mgrid[:H, :W]

    def blob() -> np.ndarray:
        centre, radius = generator.random(2) * shape, generator.random() * max(shape) / 2
        return ((y - centre[0]) ** 2 + (x - centre[1]) ** 2 < radius**2) ^ (generator.random(shape) < 0.002)

    masks = np.array([blob() for _ in range(3)])
    shifted = np.roll(masks, generator.integers(-4, 5, 2), axis=(1, 2))
    wanted = [slow_boundary_f(*pair) for pair in zip(shifted, masks, strict=True)]
    assert frame_scores(shifted, masks).f == pytest.approx(wanted)
    noise = generator.random((2, 3, *shape)) < 0.5
    wanted = [slow_boundary_f(*pair) for pair in zip(*noise, strict=True)]
    assert frame_scores(*noise).f == pytest.approx(wanted)


def test_frame_scores_by_hand():
    empty = rectangle((0, 0), (0, 0))
    truth = np.array([rectangle((4, 8), (4, 8)), rectangle((4, 8), (4, 8)), empty, rectangle((4, 8), (4, 8)), empty])
    predicted = np.array([truth[0], rectangle((4, 8), (6, 10)), empty, empty, truth[0]])
    j, f = frame_scores(predicted, truth)
    assert j == pytest.approx([1, 1 / 3, 1, 0, 0])
    # The boundary of the square is a ring of 16 pixels, rows 3-7 and columns 3-7; that of the moved one columns 5-9.
    # The disk has radius ceil(0.008 * 20) = 1. Of the rows 3 and 7 columns 5 to 8 match, 2 x 4; of the side in column 5
    # the two pixels next to those rows; of the side in column 9 none. So 10 of 16, and the same the other way.
    assert f == pytest.approx([1, 10 / 16, 1, 0, 0])
    assert frame_scores(predicted, truth, empty="vggt4d").j == pytest.approx([1, 1 / 3, 0, 0, 0])
    assert frame_scores(predicted, truth, empty="vggt4d").f == pytest.approx(f)


def test_boundary_f_by_hand():
    """Two half planes: boundaries are columns. A disk of radius 1 reaches the next column and no further."""
    shape = (1, 10, 20)
    truth = np.broadcast_to(np.arange(20) < 10, shape)  # its boundary is column 9
    assert frame_scores(np.broadcast_to(np.arange(20) < 11, shape), truth).f == 1
    assert frame_scores(np.broadcast_to(np.arange(20) < 12, shape), truth).f == 0
    stripe = np.broadcast_to((np.arange(20) < 11) | (np.arange(20) == 15), shape)  # columns 10, 14 and 15
    assert frame_scores(stripe, truth).f == pytest.approx(2 * (1 / 3) * 1 / (1 / 3 + 1))
    assert frame_scores(truth, stripe).f == pytest.approx(2 * 1 * (1 / 3) / (1 / 3 + 1))
    assert frame_scores(np.ones(shape, bool), truth).f == 0  # a full mask has no boundary
    assert frame_scores(np.ones(shape, bool), np.zeros(shape, bool)) == (0, 1)


def strips(widths) -> np.ndarray:
    """Masks of one row of 100 pixels whose first are set: intersection over union with a full row is width / 100."""
    return np.arange(100)[None, None] < np.asarray(widths)[:, None, None]


def test_mask_scores_by_hand():
    full = strips([100] * 9)
    scores = mask_scores(strips([90, 80, 70, 60, 50, 40, 30, 20, 10]), full)
    assert scores.j_mean == pytest.approx(0.5)
    assert scores.j_recall == pytest.approx(4 / 9)  # 0.5 itself does not count
    # Edges of the bins at frames 1, 3, 5, 7, 9: the first holds frames 1 to 3, the last 7 to 9.
    assert scores.j_decay == pytest.approx(0.8 - 0.2)
    assert scores[3:] == (0, 0, 0)  # the true mask has no boundary, the others have one
    # Six frames: edges at 1, 2.25, 3.5, 4.75 and 6, so 1, 2, 4, 5 and 6.
    scores = mask_scores(strips([90, 70, 10, 10, 30, 40]), full[:6])
    assert scores.j_decay == pytest.approx(0.8 - 0.35)
    # Three frames: edges at 1, 1.5, 2, 2.5 and 3; halves go up: 1, 2, 2, 3, 3.
    scores = mask_scores(strips([90, 70, 10]), full[:3])
    assert scores.j_decay == pytest.approx(0.8 - 0.1)
    assert mask_scores(strips([90]), full[:1]) == pytest.approx((0.9, 1, 0, 0, 0, 0))
    assert mask_scores(full, full) == (1, 1, 0, 1, 1, 0)


def test_more_frames_than_a_byte_counts_have_a_decay():
    widths = np.r_[np.full(300, 80), np.full(300, 30)]
    assert mask_scores(strips(widths), strips([100] * 600)).j_decay == pytest.approx(0.5)


def test_pooled_scores_weigh_frames_alike():
    full = strips([100] * 8)
    sequences = [(strips([90, 80]), full[:2]), (strips([10, 20, 30, 40, 50, 60]), full[:6])]
    pooled = pooled_scores(sequences)
    assert pooled == mask_scores(strips([90, 80, 10, 20, 30, 40, 50, 60]), full)
    assert pooled.j_mean == pytest.approx(3.8 / 8)
    assert pooled.j_recall == pytest.approx(3 / 8)
    nothing = np.zeros((1, 1, 100), bool)
    assert pooled_scores([(nothing, nothing)], empty="vggt4d").j_mean == 0


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_mask_scores_do_not_know_which_is_the_truth(seed):
    generator = np.random.default_rng(seed)
    predicted, truth = generator.random((2, 4, 8, 9)) < generator.random((2, 4, 1, 1))
    assert mask_scores(predicted, truth) == pytest.approx(mask_scores(truth, predicted))
    frames = frame_scores(predicted, truth)
    assert frames.j.tolist() == [jaccard(*pair) for pair in zip(predicted, truth, strict=True)]
    assert ((frames.f >= 0) & (frames.f <= 1)).all()
    assert mask_scores(truth, truth) == (1, 1, 0, 1, 1, 0)


@pytest.mark.parametrize(
    ("predicted", "truth", "empty", "sentence"),
    [
        (SOME[0], SOME[0], "davis", r"shape \(2, 2\); expected \[S, H, W\]"),
        (SOME[:0], SOME[:0], "davis", r"shape \(0, 2, 2\); expected \[S, H, W\]"),
        (SOME, SOME[:, :1], "davis", "expected one shape"),
        (SOME.astype(float), SOME, "davis", "predicted mask has type float64; expected bool"),
        (SOME, SOME, "zero", "empty is 'zero'; expected one of davis, vggt4d"),
    ],
)
def test_masks_that_cannot_be_scored_are_one_sentence(predicted, truth, empty, sentence):
    for function in (mask_scores, frame_scores, lambda a, b, empty: pooled_scores([(a, b)], empty=empty)):
        with pytest.raises(InputError, match=sentence):
            function(predicted, truth, empty=empty)


def test_nothing_cannot_be_pooled():
    with pytest.raises(InputError, match="no sequences to pool"):
        pooled_scores([])
