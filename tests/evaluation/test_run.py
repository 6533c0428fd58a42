"""One bad sequence of an evaluation is a row that says why; the others go on."""

import dataclasses

import numpy as np
import pytest

from tests.scored_room import SETTINGS, Perfect, run, stage
from vggtjax.commands.report import Report
from vggtjax.errors import InputError
from vggtjax.evaluation import tables
from vggtjax.evaluation.page import write_report
from vggtjax.evaluation.records import Records
from vggtjax.evaluation.run import Scoring, evaluate

NAMES = ["n" * 300, "caf\udce9", "[/x]", "two\nlines"]


class Picky(Perfect):
    """Raises what no library raises on purpose, for the results of some sequences."""

    def __init__(self, result, errors):
        super().__init__(result, ["vggt"])
        self.errors = errors

    def results(self, names, sequence, on_stage):
        if sequence.name in self.errors:
            raise self.errors[sequence.name]
        return super().results(names, sequence, on_stage)


@pytest.mark.filterwarnings("ignore:the field of view")
def test_sequences_of_odd_names_are_scored_and_shown(tmp_path, three, capsys):
    room, (sequence, *_) = three
    sequences = [dataclasses.replace(sequence, name=name) for name in NAMES]
    out, report = tmp_path / "out", Report()
    store = Records(out)
    openers = {each.name: (lambda each=each: each) for each in sequences}
    with report.running():
        records = evaluate(openers, Perfect(room, ["[/y]"]), store, SETTINGS, Scoring(), on_stage=report.stage)
    assert [record.status for record in records] == ["ok"] * len(NAMES)
    assert len({record.name for record in records}) == len(NAMES)
    assert all(record.name.isprintable() and len(record.name) < 120 for record in records)
    write_report(out, records, store, SETTINGS)
    report.means({"[/y]": records[0].metrics})
    assert "[/y]" in capsys.readouterr().out
    again = Perfect(room, ["[/y]"])
    evaluate(openers, again, store, SETTINGS, Scoring(), on_stage=stage)
    assert not again.calls


def test_a_sequence_that_raises_is_a_row(tmp_path, three):
    room, (sequence, *_) = three

    def broken(frame):
        raise ZeroDivisionError("[/x] " + 5000 * "z" + "\n")

    def never():
        raise FileNotFoundError(2, "No such file", "caf\udce9")

    unreadable = dataclasses.replace(sequence, name="unreadable", depth=broken)
    second = dataclasses.replace(sequence, name="second")
    openers = {"never": never, "unreadable": lambda: unreadable, "second": lambda: second, "a": lambda: sequence}
    source = Picky(room, {"second": IndexError("index 9 is out of bounds")})
    store = Records(tmp_path / "out")
    records = evaluate(openers, source, store, SETTINGS, Scoring(), on_stage=stage)
    assert [record.status for record in records] == ["failed"] * 3 + ["ok"]
    assert "FileNotFoundError: " in records[0].reason
    assert records[1].reason.startswith("ZeroDivisionError: [/x] zzz")
    assert records[2].reason == "IndexError: index 9 is out of bounds"
    assert all(record.reason.isprintable() and len(record.reason) <= 1000 for record in records)
    write_report(tmp_path / "out", records, store, SETTINGS | {"root": "caf\udce9"})
    assert "IndexError" in (tmp_path / "out/index.html").read_text()
    assert "IndexError" in (tmp_path / "out/results.csv").read_text()


def test_the_log_has_the_traceback_of_errors_of_the_program_alone(tmp_path, three, caplog):
    room, (sequence, *_) = three
    openers = {name: (lambda name=name: dataclasses.replace(sequence, name=name)) for name in ("program", "library")}
    source = Picky(room, {"program": IndexError("index 9"), "library": InputError("no such result")})
    evaluate(openers, source, Records(tmp_path), SETTINGS, Scoring(), on_stage=stage)
    assert "in results" in caplog.text
    assert "IndexError: index 9" in caplog.text
    assert "no such result" not in caplog.text


def test_scores_that_raise_are_a_row(tmp_path, three):
    room, sequences = three
    reads = iter(range(100))

    def sometimes(frame):
        if next(reads) > 3:  # the fingerprint reads three frames
            raise OverflowError("not twice")
        return sequences[0].depth(frame)

    (first, second) = run([dataclasses.replace(sequences[0], depth=sometimes), sequences[1]],
                          Perfect(room, ["vggt"]), Records(tmp_path))  # fmt: skip
    assert (first.status, second.status) == ("failed", "ok")
    assert first.reason == "OverflowError: not twice"


@pytest.mark.parametrize("field", ["depth", "camera_from_world", "intrinsics", "depth_confidence"])
@pytest.mark.filterwarnings("error")
def test_numbers_that_are_not_finite_fail_in_a_sentence(tmp_path, three, field):
    room, sequences = three
    values = getattr(room, field).copy()
    values.reshape(-1)[: values.size // 3] = np.nan

    class Mixed(Perfect):
        def results(self, names, sequence, on_stage):
            changes = {field: values} if sequence.name == "a" else {}
            return {name: dataclasses.replace(room, **changes) for name in names}

    first, second = run(sequences[:2], Mixed(room, ["vggt"]), Records(tmp_path))
    assert (first.status, second.status) == ("failed", "ok")
    assert "finite" in first.reason or "not a number" in first.reason
    assert all(np.isfinite(value) for value in first.metrics.values())


def test_a_record_with_broken_curves_is_made_again(tmp_path, three):
    room, sequences = three
    store = Records(tmp_path / "out")
    run(sequences[:1], Perfect(room, ["vggt"]), store)
    (tmp_path / "out/sequences/a/vggt.npz").write_bytes(b"nothing")
    again = Perfect(room, ["vggt"])
    records = run(sequences[:1], again, store)
    assert again.calls
    write_report(tmp_path / "out", records, store, SETTINGS)


def test_a_name_is_one_line_of_a_table():
    assert tables.markdown({"a\nb": {"sequences": 1, "failed": 0}}).count("\n") == 3
