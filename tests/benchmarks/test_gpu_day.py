"""gpu-day: all parts at small size on a CPU, and what becomes of parts that fail, hang or say nothing."""

import json
import re
import sys
from types import SimpleNamespace

import pytest

import benchmarks.__main__ as benchmarks
from benchmarks.gpu_day import command
from benchmarks.gpu_day.kernels import kernel_times
from benchmarks.gpu_day.lines import Lines, read_lines


def test_all_parts_at_small_size(tmp_path, capsys):
    out = tmp_path / "day"
    assert benchmarks.main(["gpu-day", "--size", "small", "--minutes", "30", "--out", str(out)]) == 0
    report = (out / "report.md").read_text()
    for part in ("parity", "attention", "speed", "kernels"):
        assert f"- {part}: done" in report
        assert f"## {part}\n" in report
    assert sorted(path.suffix for path in out.iterdir()) == [".jsonl"] * 4 + [".md"]
    assert "NO" not in report  # a bound that does not hold
    parity = [line["cells"] for line in read_lines(out / "parity.jsonl") if "sheet" in line]
    assert {(row["case"], row["pass"]) for row in parity} == {("single", "plain")}
    assert [row["output"] for row in parity].count("depth") == 2  # in both types
    assert all(0 < row["error"] <= row["at most"] for row in parity)
    paths = [line["cells"] for line in read_lines(out / "attention.jsonl") if "sheet" in line]
    assert {row["path"] for row in paths if row.get("holds")} >= {"chosen here", "chosen here, gradient", "at once"}
    assert {row["error"] for row in paths if row["path"] == "cuDNN"} == {"not on this machine, or not for this type"}
    times = {line["cells"]["work"]: line["cells"] for line in read_lines(out / "speed.jsonl") if "sheet" in line}
    assert all(row["measured"] > 0 and row["memory GB"] > 0 for row in times.values())
    assert len(times) == 2
    *kernels, others = [line["cells"] for line in read_lines(out / "kernels.jsonl") if "sheet" in line]
    assert len(kernels) == 10
    assert [row["ms"] for row in kernels] == sorted((row["ms"] for row in kernels), reverse=True)
    assert others["kernel"].endswith(" others")
    assert "parity: done" in capsys.readouterr().out


START = "import time; from pathlib import Path; from benchmarks.gpu_day.lines import Lines; "
FAKES = {
    "parity": "raise ValueError('the device has gone')",
    "attention": "time.sleep(60)",
    "speed": "lines.row('times', work='pass', ms=1.5, holds=False); lines.row('times', work='more', holds=True)",
}


def test_a_part_that_fails_or_hangs_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    """The workers are processes of their own; here each runs a line of Python."""
    real = command.subprocess.Popen

    def popen(arguments, **options):
        *_, part, _, file = arguments
        code = f"{START}lines = Lines(Path({file!r})); lines.facts(told='before'); {FAKES[part]}"
        return real([sys.executable, "-c", code], **options)

    monkeypatch.setattr(command.subprocess, "Popen", popen)
    out = tmp_path / "day"
    arguments = ["gpu-day", "--out", str(out), "--minutes", "0.25", "--parts", "parity", "attention", "speed"]
    assert benchmarks.main(arguments) == 0
    report = (out / "report.md").read_text()
    assert "- parity: failed (1): ValueError: the device has gone" in report
    assert re.search(r"- attention: cut off after \d+ s", report)
    assert "- speed: done" in report
    assert "1 of 2 within bounds" in report
    assert report.count("- told: before") == 3  # what a part told before it ended stays
    assert report.index("| pass | 1.5 | NO |") < report.index("| more |  | yes |")
    assert (out / "parity.log").exists()
    assert not (out / "speed.log").exists()
    assert "speed: done" in capsys.readouterr().out


def test_a_line_that_is_not_whole_is_left_for_later(tmp_path):
    path = tmp_path / "lines.jsonl"
    Lines(path).row("title", one_cell=1)
    with path.open("a") as file:
        file.write('{"sheet": "ti')
    assert read_lines(path) == [{"sheet": "title", "cells": {"one cell": 1}}]
    assert json.loads(path.read_text().splitlines()[0])["sheet"] == "title"


def test_kernels_of_a_gpu_are_counted_once():
    def event(name, nanoseconds):
        return SimpleNamespace(name=name, duration_ns=nanoseconds, stats=[])

    def line(name, *events):
        return SimpleNamespace(name=name, events=events)

    stream = line("Stream #13(Compute)", event("gemm.1", 2e6), event("gemm.2", 3e6), event("softmax", 1e6))
    planes = [
        SimpleNamespace(name="/device:GPU:0", lines=[stream, line("XLA Ops", event("gemm.1", 2e6)), line("Steps")]),
        SimpleNamespace(name="/host:CPU", lines=[line("python", event("sleep", 9e9))]),
    ]
    times = kernel_times(SimpleNamespace(planes=planes))
    assert times == {"gemm": [0.002, 0.003], "softmax": [0.001]}
    tpu = SimpleNamespace(name="/device:TPU:0", lines=[line("XLA Ops", event("fusion.7", 4e6))])
    assert kernel_times(SimpleNamespace(planes=[tpu])) == {"fusion": [0.004]}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--parts", "nothing"], "parts is 'nothing'; expected one of parity"),
        (["--minutes", "0"], "minutes is 0.0"),
        ([], "is not empty; choose a new folder"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, arguments, sentence):
    (tmp_path / "file").write_text("")
    assert benchmarks.main(["gpu-day", "--out", str(tmp_path), *arguments]) == 2
    assert sentence in capsys.readouterr().err
