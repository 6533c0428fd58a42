"""Records of an evaluation: kept with their settings, resumed, averaged, and shown as tables."""

import dataclasses
import json
from contextlib import contextmanager
from typing import Literal

import numpy as np
import pytest

from tests.scored_room import room_and_truth
from vggtjax.errors import ClipError, ResultError
from vggtjax.evaluation import tables
from vggtjax.evaluation.page import write_report
from vggtjax.evaluation.records import Record, Records, costs, safe_name, summary
from vggtjax.evaluation.run import evaluate
from vggtjax.results.reconstruction import Reconstruction

SETTINGS = {"version": "0", "dataset": "room"}


@contextmanager
def stage(name):
    yield None


class Reconstructor:
    """Returns the perfect result by every method, and counts what it was asked for."""

    def __init__(self, result, failing=()):
        self.result: Reconstruction = result
        self.failing, self.calls = failing, []

    def __call__(self, sequence, methods, on_stage):
        self.calls.append((sequence.name, tuple(methods)))
        if sequence.name in self.failing:
            raise ClipError(f"{sequence.name} cannot be read")
        with on_stage("first pass"):
            pass
        return dict.fromkeys(methods, self.result)


@pytest.fixture
def three():
    room, _ = room_and_truth()
    errors = np.random.default_rng(0).uniform(0.9, 1.1, room.depth.shape).astype(np.float32)
    room = dataclasses.replace(room, depth=room.depth * errors)
    return room, [room_and_truth(name=name)[1] for name in ("a", "b", "../c <i>")]


def test_what_is_finished_is_not_done_again(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path)
    first = Reconstructor(room, failing=("b",))
    records = evaluate(sequences, ["vggt", "4dvggt-d"], first, store, SETTINGS, on_stage=stage)
    assert [(r.name, r.method, r.status) for r in records] == [
        ("a", "vggt", "ok"), ("a", "4dvggt-d", "ok"), ("b", "vggt", "failed"), ("b", "4dvggt-d", "failed"),
        ("../c <i>", "vggt", "ok"), ("../c <i>", "4dvggt-d", "ok"),
    ]  # fmt: skip
    assert records[2].reason == "b cannot be read"
    assert not list(tmp_path.parent.glob("c*"))  # names stay inside

    again = Reconstructor(room)
    after = evaluate(sequences, ["vggt", "4dvggt-d", "vggt4d"], again, store, SETTINGS, on_stage=stage)
    assert again.calls == [("a", ("vggt4d",)), ("b", ("vggt", "4dvggt-d", "vggt4d")), ("../c <i>", ("vggt4d",))]
    assert [r.status for r in after] == ["ok"] * 9
    assert after[0].metrics == records[0].metrics

    changed = Reconstructor(room)
    evaluate(sequences[:1], ["vggt"], changed, store, SETTINGS | {"stride": 2}, on_stage=stage)
    assert changed.calls == [("a", ("vggt",))]  # other settings are another evaluation


@pytest.mark.parametrize("content", ["", "{", "[]", '{"name": 1}', '{"name": "a", "method": "vggt", "status": "ok"}'])
def test_a_broken_record_is_made_again(tmp_path, three, content):
    room, sequences = three
    store = Records(tmp_path)
    evaluate(sequences[:1], ["vggt"], Reconstructor(room), store, SETTINGS, on_stage=stage)
    (tmp_path / "sequences/a/vggt.json").write_text(content)
    again = Reconstructor(room)
    assert evaluate(sequences[:1], ["vggt"], again, store, SETTINGS, on_stage=stage)[0].status == "ok"
    assert again.calls


def test_broken_curves_are_named(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path)
    records = evaluate(sequences[:1], ["vggt"], Reconstructor(room), store, SETTINGS, on_stage=stage)
    (tmp_path / "sequences/a/vggt.npz").write_bytes(b"nothing")
    with pytest.raises(ResultError, match=r"vggt\.npz cannot be read: .* delete it and run again"):
        store.curves(records[0])


def record(name, method="m", status: Literal["ok", "failed"] = "ok", frames=1, **metrics):
    return Record(name, method, status, {}, metrics=metrics, frames=frames, seconds={"first pass": 2.0})


def test_means_by_hand():
    records = [
        record("a", ate=1.0, abs_rel=0.1, depth_pixels=300, j_mean=1.0, frames=1),
        record("b", ate=3.0, abs_rel=0.5, depth_pixels=100, j_mean=0.0, frames=3),
        record("c", j_mean=0.5, frames=4),
        record("d", status="failed"),
    ]
    means = summary(records)["m"]
    assert (means["sequences"], means["failed"]) == (3, 1)
    assert means["ate"] == 2  # of those that have one
    assert means["abs_rel"] == pytest.approx(0.2)
    assert means["j_mean"] == 0.5
    assert means["j_pooled"] == pytest.approx((1 * 1 + 3 * 0 + 4 * 0.5) / 8)
    assert "depth_pixels" not in means


def test_shared_passes_cost_once():
    records = [record("a", "x"), record("a", "y"), record("b", "x")]
    assert costs(records) == {"first pass": 2.0}


MEANS = {
    "vggt": {"accuracy_mean": 0.1234, "ate": 0.2, "j_mean": 0.5, "sequences": 2, "failed": 0},
    "a_b|<c>": {"accuracy_mean": 0.1232, "ate": 0.3, "sequences": 1, "failed": 1},
}


def test_tables_by_hand():
    lines = tables.markdown(MEANS).splitlines()
    assert lines[0] == "| Method | Acc. mean ↓ | ATE ↓ | J mean ↑ | Failed |"
    assert lines[2] == "| vggt | 0.123 | **0.200** | 0.500 | 0 of 2 |"  # equal by the digits shown: neither is best
    assert lines[3] == r"| a_b\|<c> | 0.123 | 0.300 | - | 1 of 2 |"
    latex = tables.latex(MEANS)
    assert r"vggt & 0.123 & \textbf{0.200} & 0.500 \\" in latex
    assert r"a\_b|$<$c$>$ & 0.123 & 0.300 & - \\" in latex


def test_lines_of_the_csv_are_inert():
    text = tables.comma_separated([record("=1+1", ate=0.5), record("b", status="failed")])
    assert text.splitlines() == ["sequence,method,status,frames,ate,reason", "'=1+1,m,ok,1,0.5,", "b,m,failed,1,,"]


def test_names_of_files():
    assert safe_name("walking_xyz-1") == "walking_xyz-1"
    names = {safe_name(name) for name in ("../a", "..\\a", "a b", "a.b", "", "é" * 300)}
    assert len(names) == 6
    assert all(name and "/" not in name and "." not in name and len(name) < 100 for name in names)


def test_all_files_of_a_report(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path)
    reconstruct = Reconstructor(room, failing=("b",))
    records = evaluate(sequences, ["vggt", "4dvggt-d"], reconstruct, store, SETTINGS, on_stage=stage)
    write_report(tmp_path, records, store, SETTINGS, warnings=["<b>mind</b>"])
    values = json.loads((tmp_path / "results.json").read_text())
    assert values["settings"] == SETTINGS
    assert {entry["status"] for entry in values["sequences"]} == {"ok", "failed"}
    assert set(values["sequences"][0]) >= {"name", "method", "status", "metrics"}
    assert values["mean"]["vggt"]["j_mean"] == 1
    page = (tmp_path / "index.html").read_text()
    assert "<i>" not in page
    assert "../c &lt;i&gt;" in page
    assert "&lt;b&gt;mind" in page
    assert "b cannot be read" in page
    for picture in ("paths", "depth", "masks", "distances", "calibration"):
        assert (tmp_path / f"plots/a/{picture}.png").stat().st_size > 2000
        assert f"plots/a/{picture}.png" in page
    assert "http" not in page  # nothing is loaded from elsewhere
    assert np.isfinite(values["mean"]["vggt"]["ate"])
