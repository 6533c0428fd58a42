"""Summaries of the ladder over draws of scenes, by hand."""

import numpy as np
import pytest

from benchmarks.summaries import changes_table, ladder_table, saliency_auc, spread, summarise
from tests.benchmarks.scenes import row


def test_summaries_by_hand():
    plain = [row(clip=0, abs_rel=0.2, saliency_auc=0.5), row(clip=1, abs_rel=0.4, saliency_auc=0.7)]
    setting = {"method": "4dvggt-d", "mask_source": "mined", "mask_pairs": 5, "suppress": "zero"}
    masked = [row(clip=0, abs_rel=0.1, **setting), row(clip=1, failure="odd", **setting)]
    by_seed = [plain + masked, [*plain[:1], row(clip=0, abs_rel=0.3, **setting)]]
    first, second = summarise(by_seed)
    assert (first.method, first.mask_source, first.clips, first.failed) == ("vggt", None, 3, 0)
    assert first.scores["abs_rel"].mean == pytest.approx((0.3 + 0.2) / 2)
    assert first.scores["abs_rel"].deviation == pytest.approx(0.1 / np.sqrt(2))
    assert (second.clips, second.failed) == (3, 1)
    assert second.scores["abs_rel"].mean == pytest.approx((0.1 + 0.3) / 2)
    assert second.ratios["abs_rel"].mean == pytest.approx((0.1 / 0.2 + 0.3 / 0.2) / 2)
    assert "rotation_error" not in second.scores
    assert saliency_auc(by_seed) == spread([0.6, 0.5])
    assert [spread([0.25]).text(), spread([1, 3]).text(2)] == ["0.250", "2.00 ± 1.41"]
    assert "1 failed" in ladder_table([first, second]).splitlines()[3]


def test_changes_by_hand():
    masked = {"mask_source": "true", "mask_pairs": 5, "suppress": "zero"}

    def rows(method, *errors, **setting):
        return [row(clip=clip, method=method, rotation_error=error, **setting) for clip, error in enumerate(errors)]

    draws = [
        rows("vggt", 4, 2) + rows("pose-decoupling", 3, 2, **masked) + rows("4dvggt-d", 1, 2, **masked),
        rows("vggt", 1, 5) + rows("pose-decoupling", 1, 4, **masked) + rows("4dvggt-d", 2, None, **masked),
    ]
    plain, decoupled, ours = summarise(draws)
    assert plain.changes == {}
    change = decoupled.changes["rotation_error"]
    assert (change.mean, change.share) == (-0.5, -0.5 / 3)
    assert change.error == pytest.approx(np.std([-1, 0, 0, -1], ddof=1) / 2)
    # in draw 2 all methods have the first clip alone: a tie with vggt
    assert (change.better, change.best, change.draws) == (2, 1, 2)
    assert ours.changes["rotation_error"].mean == pytest.approx((-3 + 0 + 1) / 3)
    assert "| -0.500 ± 0.289 (-16.7 %); 2/2, 1/2 " in changes_table([plain, decoupled, ours])
