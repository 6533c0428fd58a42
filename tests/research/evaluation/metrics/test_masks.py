import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.masks import auc, frame_scores, jaccard, mask_scores, pooled_scores

NONE, SOME, MORE = (np.array(bits, bool).reshape(1, 2, 2) for bits in ([0, 0, 0, 0], [1, 0, 1, 0], [1, 1, 0, 0]))


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), levels=st.integers(1, 30))
def test_auc_is_the_share_of_pairs(seed, levels):
    generator = np.random.default_rng(seed)
    saliency = generator.integers(0, levels, (3, 4, 5)) / levels
    mask = generator.random((3, 4, 5)) < 0.3
    mask[0, 0, :2] = True, False
    inside, outside = saliency[mask][:, None], saliency[~mask][None]
    pairs = (inside > outside) + 0.5 * (inside == outside)
    assert auc(saliency, mask) == pytest.approx(pairs.mean())


def test_jaccard_by_hand():
    assert jaccard(SOME, MORE) == pytest.approx(1 / 3)
    assert jaccard(SOME, SOME) == 1
    assert jaccard(NONE, SOME) == 0
    assert jaccard(NONE, NONE) == 1
    predicted, truth = np.concatenate([SOME, NONE, NONE]), np.concatenate([MORE, SOME, NONE])
    assert frame_scores(predicted, truth).j == pytest.approx([1 / 3, 0, 1])
    assert frame_scores(predicted, truth, empty="vggt4d").j == pytest.approx([1 / 3, 0, 0])


def slow_boundary_f(predicted, truth) -> float:
    """The boundary measure by distances: of every boundary pixel to the nearest one of the other mask."""
    H, W = truth.shape
    radius = math.ceil(0.008 * math.sqrt(H * H + W * W))

    def edge(mask) -> np.ndarray:  # pixels that differ from the one to the right, below, or both
        near = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
        return (mask != near[:-1, 1:]) | (mask != near[1:, :-1]) | (mask != near[1:, 1:])

    found, sought = edge(predicted), edge(truth)
    if not found.any() and not sought.any():
        return 1.0
    if not found.any() or not sought.any():
        return 0.0
    ways = ((found, sought), (sought, found))
    precision, recall = ((np.asarray(distance_transform_edt(~b))[a] <= radius).mean() for a, b in ways)
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


@pytest.mark.parametrize("shape", [(9, 13), (30, 50), (80, 120), (1, 30)])  # disks of 1, 1, 2 and 1 pixels
@pytest.mark.parametrize("seed", range(2))
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
    nothing = np.zeros((1, 1, 100), bool)
    assert pooled_scores([(nothing, nothing)], empty="vggt4d").j_mean == 0


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: auc(np.zeros((1, 2, 2)), NONE), "0 dynamic and 4 static"),
        (lambda: auc(np.full((1, 2, 2), np.nan), SOME), "not finite"),
        (lambda: jaccard(SOME[0], SOME), r"has shape \(2, 2\) and the true one \(1, 2, 2\)"),
        (lambda: mask_scores(SOME[0], SOME[0]), r"shape \(2, 2\); expected \[S, H, W\]"),
    ],
)
def test_what_cannot_be_scored_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()
