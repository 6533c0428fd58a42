"""One bad sequence of an evaluation is a row that says why; the others go on."""

import dataclasses
from typing import Any, cast

import pytest

from tests.shared.scored_room import SETTINGS, Perfect, run, stage
from vggtjax.errors import ResultError
from vggtjax.interface.commands.report import Report
from vggtjax.research.evaluation.page import write_report
from vggtjax.research.evaluation.records import Records
from vggtjax.research.evaluation.run import Scoring, evaluate

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
