"""Records of an evaluation: kept with their settings, resumed, averaged, and shown as tables."""

import dataclasses
import json
import os
from typing import Any, cast

import numpy as np
import pytest

from tests.shared.scored_room import SETTINGS, Perfect, run, stage
from vggtjax.errors import ResultError
from vggtjax.interface.commands.report import Report
from vggtjax.research.evaluation import tables
from vggtjax.research.evaluation.page import is_report, write_report
from vggtjax.research.evaluation.records import BOTH_OVER_ONE, Record, Records, costs, safe_name, summary
from vggtjax.research.evaluation.run import Scoring, evaluate


def redone(store, result, sequence, settings=SETTINGS, **options):
    """Evaluate, and say whether results were asked for."""
    results = Perfect(result, ["vggt"], **options)
    run([sequence], results, store, settings)
    return bool(results.calls)


def test_what_is_finished_is_not_done_again(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path / "out")
    records = run(sequences, Perfect(room, ["vggt", "4dvggt-d"], failing=("b",)), store)
    assert [(r.name, r.method, r.status) for r in records] == [
        ("a", "vggt", "ok"), ("a", "4dvggt-d", "ok"), ("b", "vggt", "failed"), ("b", "4dvggt-d", "failed"),
        ("../c <i>", "vggt", "ok"), ("../c <i>", "4dvggt-d", "ok"),
    ]  # fmt: skip
    assert records[2].reason == "b cannot be read"
    assert not list(tmp_path.glob("c*"))  # names stay inside

    again = Perfect(room, ["vggt", "4dvggt-d"], ["vggt4d"])
    after = run(sequences, again, store)
    missing = [("a", "vggt4d"), ("b", "vggt", "4dvggt-d"), ("b", "vggt4d"), ("../c <i>", "vggt4d")]
    assert again.calls == [(name, tuple(methods)) for name, *methods in missing]
    assert [(r.status, r.method) for r in after] == 3 * [("ok", "vggt"), ("ok", "4dvggt-d"), ("ok", "vggt4d")]


def test_a_killed_run_leaves_nothing_that_stops_the_next_one(tmp_path, monkeypatch):
    store, other = Records(tmp_path / "out"), Records(tmp_path / "out")

    def killed(path):
        assert not store.folder.exists()  # no folder without a mark, at any moment
        other.begin()  # another run, at the same moment
        path.write_text("half")

    with monkeypatch.context() as patch:
        patch.setattr("vggtjax.research.evaluation.records._mark", lambda path: (patch.undo(), killed(path)))
        store.begin()
    assert [path.name for path in store.folder.iterdir()] == ["evaluation.json"]
    assert "half" not in (store.folder / "evaluation.json").read_text()

    names = ("a/.vggtjax-partial-0123456789abcdef", "a/.vggtjax-partial-0123456789abcdef.lock", "a/vggt.json")
    (store.folder / names[0]).mkdir(parents=True)
    for name in names[1:]:
        (store.folder / name).touch()
    store.begin()
    assert [path.name for path in (store.folder / "a").iterdir()] == ["vggt.json"]


def test_what_has_changed_is_done_again(tmp_path, three):
    room, (sequence, *_) = three
    store = Records(tmp_path / "out")
    assert redone(store, room, sequence)
    assert not redone(store, room, sequence)
    assert redone(store, room, sequence, SETTINGS | {"stride": 2})  # other settings
    assert redone(store, room, sequence)
    assert redone(store, room, sequence, sum_of="2")  # another result
    near = sequence.depth
    assert near is not None
    doubled = dataclasses.replace(sequence, depth=lambda frame: 2 * near(frame))
    assert redone(store, room, doubled, sum_of="2")  # other ground truth
    os.utime(sequence.pictures[2], (1, 1))
    assert redone(store, room, doubled, sum_of="2")  # other pictures


def test_what_could_not_be_scored_is_a_failure_and_not_kept(tmp_path, three):
    room, (sequence, *_) = three
    depth = room.depth.copy()
    depth[0, 0] = np.nan
    store = Records(tmp_path / "out")
    (record,) = run([sequence], Perfect(dataclasses.replace(room, depth=depth), ["vggt"]), store)
    assert record.status == "failed"
    assert "point clouds: " in record.reason
    assert "j_mean" in record.metrics
    assert summary([record])["vggt"] == {"sequences": 0, "failed": 1}
    assert redone(store, room, sequence)


def test_a_record_leaves_before_its_curves_change(tmp_path, three, monkeypatch):
    room, (sequence, *_) = three
    store = Records(tmp_path / "out")
    assert redone(store, room, sequence)

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("vggtjax.research.evaluation.records.write_arrays", killed)
    with pytest.raises(KeyboardInterrupt):
        redone(store, room, sequence, sum_of="2")
    monkeypatch.undo()
    assert redone(store, room, sequence)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        '{"name": "a", "method": "vggt", "status": "ok"}',
        {"metrics": {"ate": 10**400}},
        {"settings": json.loads("[" * 500 + "]" * 500)},
        {"unknown": 1},
    ],
)
def test_a_broken_record_is_made_again(tmp_path, three, content):
    room, (sequence, *_) = three
    store = Records(tmp_path / "out")
    assert redone(store, room, sequence)
    path = tmp_path / "out/sequences/a/vggt.json"
    if isinstance(content, dict):  # changed values of a whole record
        content = json.dumps(json.loads(path.read_text()) | content)
    path.write_text(content)
    assert redone(store, room, sequence)
    assert not redone(store, room, sequence)


def record(name, method="m", status: Any = "ok", frames=1, **metrics):
    return Record(name, method, status, {}, metrics=metrics, frames=frames, seconds={"first pass": 2.0})


def test_means_and_costs_by_hand():
    seconds = {"image features": 1.0, "first pass": 3.0, "second pass": 2.0}
    records = [
        dataclasses.replace(record("a", ate=1.0, abs_rel=0.1, depth_pixels=300, j_mean=1.0), seconds=seconds),
        record("b", ate=3.0, abs_rel=0.5, depth_pixels=100, j_mean=0.0, frames=3),
        record("c", j_mean=0.5, frames=4),
        record("d", status="failed"),
    ]
    means = summary(records)["m"]
    assert (means["sequences"], means["failed"]) == (3, 1)
    assert means["ate"] == 2  # of those that have one
    assert means["abs_rel"] == pytest.approx(0.2)
    assert means["j_pooled"] == pytest.approx((1 * 1 + 3 * 0 + 4 * 0.5) / 8)
    assert "depth_pixels" not in means
    ratio = {BOTH_OVER_ONE: pytest.approx(4 / 3)}
    assert costs(records[:2])["m"] == {"image features": 0.5, "first pass": 2.5, "second pass": 1.0} | ratio
    plain, both = (dataclasses.replace(records[0], method=name) for name in ("vggt", "4dvggt-d"))
    of_plain = {"image features": 1.0, "first pass": 3.0}
    assert costs([plain, both]) == {"vggt": of_plain, "4dvggt-d": seconds | {BOTH_OVER_ONE: 1.5}}


def test_tables_by_hand():
    means = {
        "vggt": {"accuracy_mean": 0.1234, "ate": 0.2, "j_mean": 0.5, "sequences": 2, "failed": 0},
        "a_b|<c>\n": {"accuracy_mean": 0.1232, "ate": 0.3, "sequences": 1, "failed": 1},
    }
    lines = tables.markdown(means).splitlines()
    assert lines[0] == "| Method | Acc. mean ↓ | ATE ↓ | J mean ↑ | Failed |"
    assert lines[2] == "| vggt | 0.123 | **0.200** | 0.500 | 0 of 2 |"  # equal by the digits shown: neither is best
    assert lines[3].endswith("| 0.123 | 0.300 | - | 1 of 2 |")
    assert lines[3].startswith(r"| a_b\|<c>")
    assert r"a\_b|$<$c$>$" in tables.latex(means)
    text = tables.comma_separated([record("=1+1", ate=0.5), record("b", status="failed")])  # inert
    assert text.splitlines() == ["sequence,method,status,frames,ate,reason", "'=1+1,m,ok,1,0.5,", "b,m,failed,1,,"]


def test_names_of_files():
    assert safe_name("walking_xyz-1") == "walking_xyz-1"
    names = {safe_name(name) for name in ("../a", "..\\a", "a b", "a.b", "", "é" * 300)}
    assert len(names) == 6
    assert all(name and "/" not in name and "." not in name and len(name) < 100 for name in names)


def test_all_files_of_a_report(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path / "out")
    hostile = sequences[2].name
    records = run([sequences[0], sequences[2]], Perfect(room, ["vggt"], failing=(hostile,)), store)
    out = tmp_path / "out"
    write_report(out, records, store, SETTINGS, warnings=["<b>mind</b>"])
    values = json.loads((out / "results.json").read_text())
    assert values["settings"] == SETTINGS
    assert {entry["status"] for entry in values["sequences"]} == {"ok", "failed"}
    assert values["mean"]["vggt"]["j_mean"] == 1
    page = (out / "index.html").read_text()
    assert "<i>" not in page
    assert all(words in page for words in ("../c &lt;i&gt;", "&lt;b&gt;mind", "cannot be read"))
    for picture in ("paths", "depth", "masks", "distances", "calibration"):
        assert (out / f"plots/a/{picture}.png").stat().st_size > 2000
        assert f"plots/a/{picture}.png" in page
    assert "http" not in page  # nothing is loaded from elsewhere
    assert "<b>vggt</b> failed on 1 of 2" in page
    assert is_report(out / "results.json")
    (out / "results.json").write_text('{"mine": 1}')
    assert not is_report(out / "results.json")


NAMES = ["n" * 300, "caf\udce9[/x]"]


class Picky(Perfect):
    """Raises what no library raises on purpose, for the results of some sequences."""

    def __init__(self, result, errors, method):
        super().__init__(result, [method])
        self.errors = errors

    def results(self, names, sequence, on_stage):
        if sequence.name in self.errors:
            raise self.errors[sequence.name]
        return super().results(names, sequence, on_stage)


@pytest.mark.filterwarnings("ignore:the field of view")
def test_sequences_of_odd_names_are_scored_and_those_that_raise_are_rows(tmp_path, three, capsys, caplog):
    room, (sequence, *_) = three
    less = dataclasses.replace(sequence, mask=None, world_from_camera=None, intrinsics=None)  # and so less to draw
    sequences = [dataclasses.replace(less, name=name) for name in NAMES]

    def broken(frame):
        raise ZeroDivisionError("[/x] " + 5000 * "z" + "\n")

    def never():
        raise FileNotFoundError(2, "No such file", "caf\udce9")

    sequences += [dataclasses.replace(sequence, name="unreadable", depth=broken)]
    sequences += [dataclasses.replace(sequence, name=name) for name in ("second", "a")]
    openers = {each.name: (lambda each=each: each) for each in sequences} | {"never": never}
    source = Picky(room, {"second": IndexError("index 9 is out of bounds")}, method="[/y]")
    out, report = tmp_path / "out", Report()
    store = Records(out)
    with report.running():
        records = evaluate(openers, cast(Any, source), store, SETTINGS, Scoring(), on_stage=report.stage)
    assert [record.status for record in records] == ["ok", "ok", "failed", "failed", "ok", "failed"]
    assert all(record.name.isprintable() and len(record.name) < 120 for record in records)
    assert records[2].reason.startswith("ZeroDivisionError: [/x] zzz")
    assert records[3].reason == "IndexError: index 9 is out of bounds"
    assert "FileNotFoundError: " in records[5].reason
    assert all(record.reason.isprintable() and len(record.reason) <= 1000 for record in records)
    assert "in results" in caplog.text  # the traceback of a mistake in the program
    write_report(out, records, store, SETTINGS | {"root": "caf\udce9"})
    assert "IndexError" in (out / "index.html").read_text()
    assert "IndexError" in (out / "results.csv").read_text()
    report.means({"[/y]": records[0].metrics})
    assert "[/y]" in capsys.readouterr().out
    again = Perfect(room, ["[/y]"])
    evaluate({name: openers[name] for name in NAMES}, cast(Any, again), store, SETTINGS, Scoring(), on_stage=stage)
    assert not again.calls


def test_broken_curves_are_named_and_made_again(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path)
    records = run(sequences[:1], Perfect(room, ["vggt"]), store)
    (tmp_path / "sequences/a/vggt.npz").write_bytes(b"nothing")
    with pytest.raises(ResultError, match=r"vggt\.npz cannot be read: .* delete it and run again"):
        store.curves(records[0])
    again = Perfect(room, ["vggt"])
    run(sequences[:1], again, store)
    assert again.calls
