"""The benchmark of masks: its scores by hand, the best threshold, and a small run."""

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.masks import best_mask, precision_recall
from vggtjax.evaluation.metrics.masks import jaccard


def test_precision_and_recall_by_hand():
    half = np.array([[[True, False], [True, False]]])
    none, everything = half & False, half | True
    assert precision_recall(everything, half) == (0.5, 1)
    assert precision_recall(half, everything) == (1, 0.5)
    assert precision_recall(none, half) == (1, 0)
    assert precision_recall(half, none) == (0, 1)


def test_the_best_mask_is_that_of_the_best_of_all_thresholds():
    generator = np.random.default_rng(0)
    for levels in (2, 5, 1000):
        saliency = generator.integers(0, levels, (2, 5, 6)) / levels
        truth = saliency + generator.normal(0, 0.3, saliency.shape) > 0.7
        tried = [jaccard(saliency >= value, truth) for value in np.unique(saliency)]
        assert jaccard(best_mask(saliency, truth), truth) == pytest.approx(max(tried))


def test_masks_are_measured(tmp_path, capsys):
    arguments = ["masks", "--scenes", "1", "--smooth", "1", "3", "--methods", "4dvggt-d", "--clips", str(tmp_path)]
    code = benchmarks.main(arguments)
    shown = capsys.readouterr()
    assert code == 0, shown.err
    values = [line.split() for line in shown.out.splitlines() if "as it is" in line]
    assert [row[1] for row in values] == ["1", "3"]
    assert all(0 < float(row[5]) <= 1 for row in values)  # IoU
    best = [line.split() for line in shown.out.splitlines() if "at the best" in line]
    assert all(float(row[6]) >= float(mined[5]) for row, mined in zip(best, values, strict=True))
    assert benchmarks.main(["masks", "--scenes", "0"]) == 2
