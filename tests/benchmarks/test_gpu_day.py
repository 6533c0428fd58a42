"""gpu-day: all parts at small size on a CPU, and what becomes of parts that fail, hang or say nothing."""

import re
import sys
from types import SimpleNamespace

import pytest

import benchmarks.__main__ as benchmarks
from benchmarks.gpu_day import command
from benchmarks.gpu_day.kernels import kernel_times
from benchmarks.gpu_day.lines import Lines, read_lines
from benchmarks.gpu_day.parts import PARTS


@pytest.mark.proof
def test_all_parts_at_small_size(tmp_path):
    """Each in this process; the next test runs processes."""
    told, outcomes = {}, []
    for name, part in PARTS.items():
        part.run("tiny", Lines(tmp_path / name))
        lines = read_lines(tmp_path / name)
        told[name] = [line["cells"] for line in lines if "sheet" in line]
        outcomes.append(command.Outcome(name, "done", 1.0, lines))
    report = command.report(outcomes)
    assert "NO" not in report  # a bound that does not hold
    assert all(f"- {name}: done" in report and f"## {name}\n" in report for name in PARTS)
    assert all(0 < row["error"] <= row["at most"] for row in told["parity"])
    paths = {row["path"] for row in told["attention"] if row.get("holds")}
    assert paths >= {"chosen here", "chosen here, gradient", "at once"}
    assert all(row["measured"] > 0 and row["memory GB"] > 0 for row in told["speed"])
    times = [row["ms"] for row in told["kernels"][:-1]]  # the last row sums up all others
    assert times == sorted(times, reverse=True)


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
    arguments = ["gpu-day", "--out", str(out), "--minutes", "0.12", "--parts", "parity", "attention", "speed"]
    assert benchmarks.main(arguments) == 0
    report = (out / "report.md").read_text()
    assert "- parity: failed (1): ValueError: the device has gone" in report
    assert re.search(r"- attention: cut off after \d+ s", report)
    assert "- speed: done" in report
    assert "1 of 2 within bounds" in report
    assert report.count("- told: before") == 3  # what a part told before it ended stays
    assert report.index("| pass | 1.5 | NO |") < report.index("| more |  | yes |")
    assert "speed: done" in capsys.readouterr().out
    with (out / "speed.jsonl").open("a") as file:
        file.write('{"sheet": "ti')  # a line that is not whole is left for later
    assert len(read_lines(out / "speed.jsonl")) == 3


def test_kernels_of_a_gpu_are_counted_once():
    def plane(name, **lines):
        found = [SimpleNamespace(name=each, events=[event(*kernel) for kernel in lines[each]]) for each in lines]
        return SimpleNamespace(name=name, lines=found)

    def event(name, nanoseconds):
        return SimpleNamespace(name=name, duration_ns=nanoseconds, stats=[])

    stream = [("gemm.1", 2e6), ("gemm.2", 3e6), ("softmax", 1e6)]
    gpu = plane("/device:GPU:0", **{"Stream #13(Compute)": stream, "XLA Ops": [("gemm.1", 2e6)], "Steps": []})
    host = plane("/host:CPU", python=[("sleep", 9e9)])
    assert kernel_times(SimpleNamespace(planes=[gpu, host])) == {"gemm": [0.002, 0.003], "softmax": [0.001]}
    tpu = plane("/device:TPU:0", **{"XLA Ops": [("fusion.7", 4e6)]})
    assert kernel_times(SimpleNamespace(planes=[tpu])) == {"fusion": [0.004]}
