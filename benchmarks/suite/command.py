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
from vggtjax.errors import InputError, check_extra
from vggtjax.storage.kept_memory import keep_freed_memory
from vggtjax.storage.writing import writing


def suite(
    *,
    workloads: tuple[str, ...] = tuple(WORKLOADS),
    sizes: tuple[Size, ...] = ("demo",),
    weights: Path | None = None,
    frames: tuple[int, ...] = (2, 8),
    height: int | None = None,
    width: int | None = None,
    dtype: DType = "float32",
    repeats: int = 3,
    out: Path | None = None,
    markdown: Path | None = None,
    against: Path | None = None,
    plots: Path | None = None,
) -> None:
    """Time named workloads beside a floor: their work divided by the best rates of this machine.

    Args:
        workloads: their names; all by default.
        sizes: of the model. tiny: for a quick trial. demo: the embedded model. full: VGGT-1B with random weights.
        weights: a converted checkpoint for size full.
        frames: numbers of frames.
        height: of a frame, in pixels; 56, 64 and 294 for the three sizes by default.
        width: of a frame, in pixels; 56, 64 and 518 by default.
        dtype: type of the products in the blocks.
        repeats: timed runs of each workload, after a warm-up.
        out: JSON file for the results.
        markdown: file for the same tables.
        against: JSON file of an earlier run to compare the medians with.
        plots: folder for roofline.png and scaling.png.
    """
    if unknown := [name for name in workloads if name not in WORKLOADS]:
        raise InputError(f"workloads has {unknown}; expected some of {list(WORKLOADS)}")
    if weights is not None and "full" not in sizes:
        raise InputError(f"weights is {weights} and sizes is {list(sizes)}; expected full among the sizes")
    check_counts(frames, repeats)
    stored = None if against is None else report.read_stored(against)
    if plots is not None:
        check_extra("plotting", "train", "matplotlib")
    keep_freed_memory()
    rows: list[Row] = []
    sheets: list[report.Sheet] = []
    measurements: dict[str, dict[str, list[float]]] = {}
    screen = report.console()

    def run(size: Size, progress: Progress) -> None:
        task = progress.add_task(f"{size}: weights", total=None)
        config, params = load(size, weights if size == "full" else None)
        shape = frame_size(size, config, height, width)
        cases = [Case(size, config, params, count, *shape, dtype) for count in frames]
        wanted = [name for name in workloads if WORKLOADS[name].scope != "process" or size == sizes[0]]
        progress.update(task, description=f"{size}: ceilings")
        counted = any(WORKLOADS[name].parts for name in wanted)
        ceilings = Ceilings(config, cases[0].grid, dtype) if counted else None
        runs = [(name, case) for name in wanted for case in cases[: None if WORKLOADS[name].scope == "clip" else 1]]
        progress.update(task, total=len(runs))
        found: list[Row] = []
        for name, case in runs:
            progress.update(task, description=f"{size}: {name}, {case.frames} frames")
            found.extend(measured_rows(name, WORKLOADS[name], case, repeats, ceilings))
            progress.advance(task)
        rows.extend(found)
        title = f"{size}, {shape[1]} x {shape[0]} pixels, {dtype}"
        if ceilings is not None:
            measurements[size] = ceilings.measurements
            sheets.append(report.ceiling_sheet(title, ceilings.measurements))
        sheets.append(report.row_sheet(f"{title}, {repeats} runs", found))

    with compiling_anew(), Progress(console=screen, transient=True) as progress:
        for size in dict.fromkeys(sizes):
            run(size, progress)
    here = report.describe(report.machine())
    if stored is not None and against is not None:
        sheets.append(report.comparison_sheet(rows, stored, against))
    for sheet in sheets:
        sheet.show(screen)
    screen.print(here, highlight=False)
    if out is not None:
        report.write_rows(out, rows, ceilings=measurements, repeats=repeats)
    if markdown is not None:
        with writing(markdown) as temporary:
            temporary.write_text("\n".join([here + "\n", *(sheet.markdown() for sheet in sheets)]), encoding="utf-8")
    if plots is not None:
        from benchmarks.suite.pictures import plot_roofline, plot_scaling

        plot_roofline(plots / "roofline.png", rows, here)
        plot_scaling(plots / "scaling.png", rows, here)


def measured_rows(
    name: str, workload: Workload, case: Case, repeats: int, ceilings: Ceilings | None = None
) -> list[Row]:
    """Measure a workload; return a row for each of its results, with ceilings if its work is known."""
    parts = workload.parts(case) if workload.parts else []
    rounds = Rounds(repeats, ceilings) if parts and ceilings else range(repeats)
    size = None if workload.scope == "process" else case.size
    shape = (case.frames, case.height, case.width) if workload.scope == "clip" else (None, None, None)
    results = without_memory(lambda: workload.measure(case, rounds))
    rates = rounds.rates if isinstance(rounds, Rounds) else ()
    names = [f"{name}: {result}" if result else name for result in results]
    return [
        Row(full, size, *shape, case.dtype, measured, parts, () if measured.failure else rates)
        for full, measured in zip(names, results.values(), strict=True)
    ]
