"""Times of all parts, compared with what the machine could reach: python -m benchmarks suite."""

from __future__ import annotations

from pathlib import Path

from rich.progress import Progress

from benchmarks.suite import report
from benchmarks.suite.cases import Case, DType, Size, check_counts, frame_size, load
from benchmarks.suite.ceilings import Ceilings, Rounds
from benchmarks.suite.measure import compiling_anew, without_memory
from benchmarks.suite.report import Row
from benchmarks.suite.workloads import WORKLOADS, Workload
from vggtjax.errors import InputError
from vggtjax.storage.process import keep_freed_memory


def suite(
    *,
    workloads: tuple[str, ...] = tuple(WORKLOADS),
    size: Size = "demo",
    frames: tuple[int, ...] = (2, 8),
    height: int | None = None,
    width: int | None = None,
    dtype: DType = "float32",
    repeats: int = 3,
    out: Path | None = None,
    against: Path | None = None,
) -> None:
    """Time named workloads beside a floor: their work divided by the best rates of this machine.

    Args:
        workloads: their names; all by default.
        size: of the model. tiny: for a quick trial. demo: the embedded model. full: VGGT-1B with random weights.
        frames: numbers of frames.
        height: of a frame, in pixels; 294 for full by default, the model's own for the others.
        width: of a frame, in pixels; 518 for full by default, the model's own for the others.
        dtype: type of the products in the blocks.
        repeats: timed runs of each workload, after a warm-up.
        out: JSON file for the results.
        against: JSON file of an earlier run to compare the medians with.
    """
    if unknown := [name for name in workloads if name not in WORKLOADS]:
        raise InputError(f"workloads has {unknown}; expected some of {list(WORKLOADS)}")
    check_counts(frames, repeats)
    stored = None if against is None else report.read_stored(against)
    keep_freed_memory()
    rows: list[Row] = []
    screen = report.console()
    with compiling_anew(), Progress(console=screen, transient=True) as progress:
        task = progress.add_task("weights", total=None)
        config, params = load(size)
        shape = frame_size(size, config, height, width)
        cases = [Case(size, config, params, count, *shape, dtype) for count in frames]
        progress.update(task, description="ceilings")
        counted = any(WORKLOADS[name].parts for name in workloads)
        ceilings = Ceilings(config, cases[0].grid, dtype) if counted else None
        runs = [(name, case) for name in workloads for case in cases[: None if WORKLOADS[name].of_a_clip else 1]]
        progress.update(task, total=len(runs))
        for name, case in runs:
            progress.update(task, description=f"{name}, {case.frames} frames")
            rows += measured_rows(name, WORKLOADS[name], case, repeats, ceilings)
            progress.advance(task)
    title = f"{size}, {shape[1]} x {shape[0]} pixels, {dtype}"
    measurements = {} if ceilings is None else ceilings.measurements
    if measurements:
        report.ceiling_sheet(title, measurements).show(screen)
    report.row_sheet(f"{title}, {repeats} runs", rows).show(screen)
    if stored is not None and against is not None:
        report.comparison_sheet(rows, stored, against).show(screen)
    screen.print(report.describe(report.machine()), highlight=False)
    if out is not None:
        report.write_rows(out, rows, ceilings=measurements, repeats=repeats)


def measured_rows(
    name: str, workload: Workload, case: Case, repeats: int, ceilings: Ceilings | None = None
) -> list[Row]:
    """Measure a workload; return a row for each of its results, with ceilings if its work is known."""
    parts = workload.parts(case) if workload.parts else []
    rounds = Rounds(repeats, ceilings) if parts and ceilings else range(repeats)
    about = (case.size, case.frames, case.height, case.width) if workload.of_a_clip else (None, None, None, None)
    results = without_memory(lambda: workload.measure(case, rounds))
    rates = rounds.rates if isinstance(rounds, Rounds) else ()
    names = [f"{name}: {result}" if result else name for result in results]
    return [
        Row(full, *about, case.dtype, measured, parts, () if measured.failure else rates)
        for full, measured in zip(names, results.values(), strict=True)
    ]
