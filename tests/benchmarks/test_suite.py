"""The benchmark suite: its work model against known figures, small runs of every workload, stored runs."""

import json

import jax
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.suite import ceilings, measure, work, workloads
from benchmarks.suite.workloads import WORKLOADS
from vggtjax.config import VGGTConfig
from vggtjax.network.model import parameter_shapes

FULL = VGGTConfig()
SMALL, LARGE = (21, 37), (28, 37)  # 518 x 294, 518 x 392
TERA = 1e12


@pytest.fixture(scope="module", autouse=True)
def quickly():
    """Programs are compiled sooner and run slower, and ceilings are rough: no test checks speed."""
    jax.config.update("jax_disable_most_optimizations", True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "_SUSTAINED", 1e-3)
        patch.setattr(ceilings, "_IN_A_ROW", 1)
        yield
    jax.config.update("jax_disable_most_optimizations", False)


def trunk(S, grid):
    return work.backbone(FULL, S, grid) + work.alternating(FULL, S, grid)


def test_work_against_known_figures():
    for S in (1, 8, 100):
        assert work.flop(trunk(S, SMALL)) == pytest.approx((1.538 * S + 0.0601 * S**2) * TERA, rel=0.002)
        assert work.flop(trunk(S, LARGE)) == pytest.approx((2.10 * S + 0.1065 * S**2) * TERA, rel=0.002)
    assert work.flop(work.backbone(FULL, 3, LARGE)) == pytest.approx(3 * 0.737 * TERA, rel=0.002)
    _, pair = work.alternating(FULL, 1, LARGE)
    assert (pair["linear"], pair["attention"]) == pytest.approx((0.629 * TERA, 0.1065 * TERA), rel=0.002)
    assert pair["exp"] == 24 * 16 * (5 + 28 * 37) ** 2
    kernels = [leaf.size for leaf in jax.tree.leaves(parameter_shapes(FULL)["camera_head"]) if leaf.ndim > 1]
    assert work.camera_head(FULL, 1)[0]["weights"] == pytest.approx(4 * 4 * sum(kernels), rel=0.001)
    both = trunk(8, LARGE) + work.alternating(FULL, 8, LARGE)
    both += 2 * (work.camera_head(FULL, 8) + work.depth_head(FULL, 8, LARGE))
    assert work.flop(both) == pytest.approx((3.913 * 8 + 0.2131 * 64) * TERA, rel=0.02)
    assert work.flop(work.cues(FULL, 3, LARGE)) == pytest.approx(3 * 6.6e9, rel=0.02)


@pytest.mark.proof
def test_workloads_run(tmp_path, capsys, monkeypatch):
    """Compiling is timed with a smaller program; fresh processes do nothing but to look for the cache of the first."""
    names = sorted(set(WORKLOADS) - {"two-passes"})
    monkeypatch.setattr(workloads, "two_passes", workloads.cue_sums)
    look = "import os, pathlib; pathlib.Path(os.environ['VGGTJAX_CACHE']).mkdir(exist_ok=True)"
    monkeypatch.setattr(workloads, "DEMO", ("-c", look))
    monkeypatch.setattr(workloads, "_STARTS", {"nothing": "pass"})
    stored = tmp_path / "a.json"
    arguments = ["suite", "--size", "tiny", "--frames", "2", "--repeats", "1"]
    assert benchmarks.main([*arguments, "--workloads", *names, "--out", str(stored)]) == 0, capsys.readouterr().err
    written = json.loads(stored.read_text())
    assert all(min(rates) > 0 for rates in written["ceilings"].values())
    rows = written["rows"]
    assert {row["workload"].split(":")[0] for row in rows} == set(names)
    for row in rows:
        assert row["seconds"] == [row["median"]]
        if WORKLOADS[row["workload"].split(":")[0]].parts:
            assert row["floor_seconds"] == pytest.approx(sum(row["floor"].values()))
            assert row["flop_per_second"] == pytest.approx(row["flop"] / row["median"])
    capsys.readouterr()
    assert benchmarks.main([*arguments, "--workloads", "cues", "--against", str(stored)]) == 0
    assert "1 of 1 rows are in both" in capsys.readouterr().out
