"""All that the first hour on an accelerator should tell, in minutes: python -m benchmarks gpu-day."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from benchmarks.gpu_day.lines import Line, read_lines
from benchmarks.gpu_day.parts import PARTS
from benchmarks.suite.report import Sheet, console, number
from vggtjax.errors import InputError, check_choice, one_line
from vggtjax.storage.writing import write_errors, writing

_ROOT = Path(__file__).parents[2]  # of the repository, whose golden numbers the parts read
_POLL = 0.3  # seconds
_KILLED = 5.0  # seconds that a killed process may take to end


@dataclass
class Outcome:
    """How a part went so far."""

    name: str
    state: str = "running"
    seconds: float = 0.0
    lines: list[Line] = field(default_factory=list)

    def count(self, holds: bool) -> int:
        """Return the number of rows whose bound or target is met, or is not."""
        return sum(line["cells"].get("holds") is holds for line in self.lines if "sheet" in line)


def gpu_day(
    *,
    out: Path,
    size: Literal["full", "small"] = "full",
    minutes: float = 9.0,
    parts: tuple[str, ...] = tuple(PARTS),
) -> None:
    """Tell what the first hour on an accelerator should: parity, attention, speed and memory, and the longest kernels.

    Every part is a process with a share of the time; what it leaves over is the next one's. A part that fails or takes
    too long is written down, and the others go on. The report is written again with every line that is told.

    Args:
        out: folder for report.md, the lines of every part, and the output of failed parts. It must be new or empty.
        size: full is VGGT-1B with random weights, with frames of 518 x 392 pixels in bfloat16; small, a trial of a few
            seconds on a CPU.
        minutes: of all parts together.
        parts: some of parity, attention, speed and kernels.
    """
    for name in parts:
        check_choice("parts", name, tuple(PARTS))
    if not parts or not 0 < minutes < 24 * 60:
        raise InputError(f"minutes is {minutes} for {len(parts)} parts; expected more than 0 minutes and parts")
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise InputError(f"{out} is not empty; choose a new folder")
    screen, began, spare = console(), time.monotonic(), 0.0
    outcomes: list[Outcome] = []
    whole = sum(PARTS[name].share for name in parts)
    for name in parts:
        outcomes.append(Outcome(name))
        limit = 60 * minutes * PARTS[name].share / whole + spare
        with screen.status(f"{name}, at most {limit:.0f} s"):
            _run(outcomes, "tiny" if size == "small" else "full", limit, out)
        spare = limit - outcomes[-1].seconds
        screen.print(_line(outcomes[-1]), highlight=False)
    screen.print(f"{time.monotonic() - began:.0f} s in all; {out / 'report.md'}", highlight=False)
    if all(outcome.state != "done" for outcome in outcomes):
        raise InputError(f"no part came to its end; the reasons are in {out / 'report.md'}")


def _run(outcomes: Sequence[Outcome], size: str, limit: float, out: Path) -> None:
    """Run the last part in a process of its own, for at most `limit` seconds."""
    outcome, began = outcomes[-1], time.monotonic()
    lines, log = out / f"{outcome.name}.jsonl", out / f"{outcome.name}.log"
    command = [sys.executable, "-m", "benchmarks.gpu_day.parts", outcome.name, size, str(lines.resolve())]
    with log.open("wb") as said, subprocess.Popen(
        command, cwd=_ROOT, stdin=subprocess.PIPE, stdout=said, stderr=subprocess.STDOUT
    ) as process:  # fmt: skip
        try:
            while (code := process.poll()) is None and outcome.seconds <= limit:
                time.sleep(_POLL)
                outcome.seconds = time.monotonic() - began
                if (told := read_lines(lines)) != outcome.lines or not outcome.lines:
                    outcome.lines = told
                    _write(outcomes, out)
        except BaseException:
            outcome.state = "interrupted"
            raise
        finally:
            if process.poll() is None:
                process.kill()
                process.wait(_KILLED)
            outcome.lines = read_lines(lines)
            _write(outcomes, out)
    if code == 0:
        outcome.state = "done"
        log.unlink()
    else:
        outcome.state = f"cut off after {limit:.0f} s" if code is None else _failure(code, log)
    _write(outcomes, out)


def _failure(code: int, log: Path) -> str:
    last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:] or ["without a word"]
    return f"failed ({code}): {one_line(last[0], 200)}"


def _line(outcome: Outcome) -> str:
    held, missed = outcome.count(True), outcome.count(False)
    verdict = f", {held} of {held + missed} within bounds" if held + missed else ""
    return f"{outcome.name}: {outcome.state}, {outcome.seconds:.0f} s{verdict}"


def _write(outcomes: Sequence[Outcome], out: Path) -> None:
    with writing(out / "report.md") as temporary:
        temporary.write_text(report(outcomes), encoding="utf-8")


def report(outcomes: Sequence[Outcome]) -> str:
    """Return the report so far: a line per part, then what each part has told; what does not hold stands first."""
    text = ["# The first hour on an accelerator\n"]
    text += [f"- {_line(outcome)}" for outcome in outcomes]
    for outcome in outcomes:
        text += [f"\n## {outcome.name}\n", f"{PARTS[outcome.name].about}\n"]
        facts = {name: value for line in outcome.lines for name, value in line.get("facts", {}).items()}
        text += [f"- {name.replace('_', ' ')}: {_shown(value)}" for name, value in facts.items()]
        sheets: dict[str, list[dict]] = {}
        for line in outcome.lines:
            if "sheet" in line:
                sheets.setdefault(line["sheet"], []).append(line["cells"])
        for title, rows in sheets.items():
            headings = tuple(dict.fromkeys(name for row in rows for name in row))
            rows = sorted(rows, key=lambda row: row.get("holds") is not False)
            cells = [tuple(_shown(row.get(name)) for name in headings) for row in rows]
            text += ["", Sheet(title, headings, cells).markdown()]
    return "\n".join(text) + "\n"


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return number(value) if isinstance(value, float) else "" if value is None else str(value)
