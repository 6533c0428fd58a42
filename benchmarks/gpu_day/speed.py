"""Times and memory beside their targets and VGGT's published figures."""

from __future__ import annotations

import jax

from benchmarks.gpu_day.lines import Cell, Lines
from benchmarks.suite.cases import Case, DType, Size, config_of, frame_size, load
from benchmarks.suite.command import measured_rows
from benchmarks.suite.gpu_targets import FRAME, HEADINGS, PUBLISHED, TARGETS, figure
from benchmarks.suite.measure import compiling_anew
from benchmarks.suite.workloads import WORKLOADS

_REPEATS = 3
_JOBS = {  # in the order of what they tell: a cut-off run has the first ones
    "tiny": (("aggregator", 2), ("depth-head", 2)),
    "full": (
        *(("aggregator", 8), ("depth-head", 8), ("two-passes", 8), ("aggregator", 1), ("aggregator", 20)),
        *(("aggregator", 50), ("aggregator", 100), ("two-passes", 100), ("aggregator", 200), ("depth-head", 100)),
    ),
}


def speed(size: Size, lines: Lines) -> None:
    """Measure aggregator, depth head and both passes by number of frames."""
    config, params = load(size)
    height, width = full_frame(size)
    dtype: DType = "float32" if size == "tiny" else "bfloat16"
    wanted = TARGETS if "H200" in jax.local_devices()[0].device_kind and size == "full" else {}
    published = PUBLISHED if size == "full" else {}
    title = f"{size}, {width} x {height} pixels, {dtype}: medians of {_REPEATS} runs; published: VGGT on an H100"
    with compiling_anew():
        for name, frames in _JOBS["tiny" if size == "tiny" else "full"]:
            case = Case(size, config, params, frames, height, width, dtype)
            (row,) = measured_rows(name, WORKLOADS[name], case, _REPEATS)
            cells: dict[str, Cell] = {"work": HEADINGS[name], "frames": frames}
            if row.measured.failure:
                lines.row(title, **cells, measured=row.measured.failure, holds=False)
                continue
            value, target = figure(name, row), wanted.get(name, {}).get(frames)
            cells |= {"measured": value, "target": target, "published": published.get(name, {}).get(frames)}
            if target is not None:
                cells["holds"] = value is not None and value <= target
            memory = figure("memory", row)
            cells |= {"compile_s": row.measured.compile_seconds, "memory_GB": memory}
            cells["memory_target"] = wanted.get("memory", {}).get(frames) if name == "aggregator" else None
            lines.row(title, **cells)


def full_frame(size: Size) -> tuple[int, int]:
    """Return height and width: those of the targets for the full model."""
    height, width = FRAME if size == "full" else (None, None)
    return frame_size(size, config_of(size), height, width)
