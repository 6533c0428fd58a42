"""Target and measured times and memory on an H200: python -m benchmarks gpu-targets."""

from __future__ import annotations

from pathlib import Path

from rich.progress import Progress

from benchmarks.suite.cases import Case, DType, Size, check_counts, frame_size, load
from benchmarks.suite.command import measured_rows
from benchmarks.suite.measure import compiling_anew
from benchmarks.suite.report import Row, Sheet, console, describe, machine, number, write_rows
from benchmarks.suite.workloads import WORKLOADS
from vggtjax.errors import InputError
from vggtjax.storage.kept_memory import keep_freed_memory

FRAME = (392, 518)
_PROGRAMS = ("aggregator", "depth-head", "two-passes")
# By number of frames, for an H200, the full model in bfloat16, and frames of 518 x 392.
TARGETS = {
    "aggregator": {1: 8.0, 8: 55.0, 20: 190.0, 50: 850.0, 100: 2800.0},  # ms
    "depth-head": dict.fromkeys((1, 8, 20, 50, 100, 200), 2.0),  # ms a frame
    "two-passes": {100: 6.5},  # s
    "memory": {200: 9.0},  # GB beyond weights
}
# VGGT (arXiv 2503.11651 and its repository) on an H100 with FlashAttention 3; memory with weights.
PUBLISHED = {
    "aggregator": {1: 40.0, 8: 110.0, 20: 310.0, 50: 1040.0, 100: 3120.0, 200: 8750.0},
    "depth-head": dict.fromkeys((1, 8, 20, 50, 100, 200), 30.0),
    "memory": {1: 1.9, 8: 3.2, 20: 5.6, 50: 11.4, 100: 21.2, 200: 40.6},
}
HEADINGS = {
    "aggregator": "aggregator (ms)",
    "depth-head": "depth head (ms a frame)",
    "two-passes": "two passes (s)",
    "memory": "memory (GB)",
}


def gpu_targets(
    *,
    size: Size = "full",
    weights: Path | None = None,
    frames: tuple[int, ...] = (1, 8, 20, 50, 100, 200),
    height: int | None = None,
    width: int | None = None,
    dtype: DType = "bfloat16",
    repeats: int = 5,
    out: Path | None = None,
) -> None:
    """Measure aggregator, depth head, two passes and memory beside their targets and VGGT's published figures.

    Memory is the most that one of the three takes beyond weights and inputs: the device's own count, or XLA's analysis
    where there is none. Targets are shown on an H200, published figures for the full model, at 518 x 392 in bfloat16.

    Args:
        size: of the model.
        weights: a converted checkpoint for size full; random weights by default.
        frames: numbers of frames.
        height: of a frame, in pixels; 392 for full by default.
        width: of a frame, in pixels; 518 for full by default.
        dtype: type of the products in the blocks.
        repeats: timed runs of each, after a warm-up.
        out: JSON file for the results.
    """
    if weights is not None and size != "full":
        raise InputError(f"weights is {weights} and size is {size}; expected size full")
    check_counts(frames, repeats)
    keep_freed_memory()
    screen = console()
    found: dict[int, dict[str, Row]] = {}
    with compiling_anew(), Progress(console=screen, transient=True) as progress:
        task = progress.add_task("weights", total=len(frames) * len(_PROGRAMS))
        config, params = load(size, weights)
        if size == "full":
            height, width = FRAME[0] if height is None else height, FRAME[1] if width is None else width
        shape = frame_size(size, config, height, width)
        for count in sorted(set(frames)):
            case = Case(size, config, params, count, *shape, dtype)
            found[count] = {}
            for name in _PROGRAMS:
                progress.update(task, description=f"{name}, {count} frames")
                (found[count][name],) = measured_rows(name, WORKLOADS[name], case, repeats)
                progress.advance(task)
    here = machine()
    comparable = size == "full" and shape == FRAME and dtype == "bfloat16"
    wanted = TARGETS if comparable and "H200" in here["device"] else {}
    headings, rows = ["frames"], [[str(count)] for count in found]
    for name, heading in HEADINGS.items():
        headings += [heading, "target", "VGGT (cited)"]
        for cells, (count, programs) in zip(rows, found.items(), strict=True):
            cells.append(_shown(name, programs))
            cells += [number(table.get(name, {}).get(count)) for table in (wanted, PUBLISHED if comparable else {})]
    title = f"{size}, {shape[1]} x {shape[0]} pixels, {dtype}, medians of {repeats}"
    Sheet(title, tuple(headings), [tuple(cells) for cells in rows]).show(screen)
    if comparable:
        screen.print("VGGT's figures are published ones for an H100; their memory includes the weights.")
    screen.print(describe(here), highlight=False)
    if out is not None:
        measured = [row for programs in found.values() for row in programs.values()]
        write_rows(out, measured, targets=wanted, published=PUBLISHED if comparable else {})


def figure(name: str, *rows: Row) -> float | None:
    """Return a figure of measured rows in the unit of its heading; "memory" is the most of all rows. None: unknown."""
    results = [row.measured for row in rows]
    if name == "memory":
        sizes = [result.xla_bytes if result.device_bytes is None else result.device_bytes for result in results]
        return max((size / 1e9 for size in sizes if size is not None), default=None)
    scale = {"aggregator": 1e3, "depth-head": 1e3 / (rows[0].frames or 1), "two-passes": 1.0}[name]
    return None if results[0].median is None else scale * results[0].median


def _shown(name: str, programs: dict[str, Row]) -> str:
    """Return a figure as text, or the reason for its absence."""
    rows = list(programs.values()) if name == "memory" else [programs[name]]
    failures = [row.measured.failure for row in rows if row.measured.failure]
    return failures[0] if failures else number(figure(name, *rows))
