"""gpu-day: all parts at small size on a CPU."""

import pytest

from benchmarks.gpu_day import command
from benchmarks.gpu_day.lines import Lines, read_lines
from benchmarks.gpu_day.parts import PARTS


@pytest.mark.proof
def test_all_parts_at_small_size(tmp_path):
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
