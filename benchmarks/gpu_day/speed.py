"""Times and memory beside their targets, the bounds of the same programs, and VGGT's published figures."""

from __future__ import annotations

import jax

from benchmarks.gpu_day.bounds import bound
from benchmarks.gpu_day.lines import Cell, Lines
from benchmarks.suite.cases import Case, DType, Size, config_of, frame_size, load
from benchmarks.suite.measure import Measured, compiling_anew, measure_program, without_memory
from benchmarks.suite.workloads import aggregator, depth_head, two_passes

FRAME = (392, 518)  # of targets and published figures; by number of frames
TARGETS = {  # for an H200, the full model in bfloat16
    "aggregator": {1: 8.0, 8: 55.0, 20: 190.0, 50: 850.0, 100: 2800.0},  # ms
    "depth-head": dict.fromkeys((1, 8, 20, 50, 100, 200), 2.0),  # ms a frame
    "two-passes": {100: 6.5},  # s
    "memory": {200: 9.0},  # GB beyond weights
}
PUBLISHED = {  # VGGT (arXiv 2503.11651 and its repository) on an H100 with FlashAttention 3
    "aggregator": {1: 40.0, 8: 110.0, 20: 310.0, 50: 1040.0, 100: 3120.0, 200: 8750.0},
    "depth-head": dict.fromkeys((1, 8, 20, 50, 100, 200), 30.0),
}
HEADINGS = {
    "aggregator": "aggregator (ms)",
    "depth-head": "depth head (ms a frame)",
    "two-passes": "two passes (s)",
}
_PROGRAMS = {"aggregator": aggregator, "depth-head": depth_head, "two-passes": two_passes}
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
    device = jax.local_devices()[0].device_kind
    wanted = TARGETS if "H200" in device and size == "full" else {}
    published = PUBLISHED if size == "full" else {}
    title = (
        f"{size}, {width} x {height} pixels, {dtype}: medians of {_REPEATS} runs; bound: counted in the same program; "
        "published: VGGT on an H100"
    )
    with compiling_anew():
        for name, frames in _JOBS["tiny" if size == "tiny" else "full"]:
            case = Case(size, config, params, frames, height, width, dtype)
            measured, text = _measured(name, case)
            cells: dict[str, Cell] = {"work": HEADINGS[name], "frames": frames}
            if measured.failure:
                lines.row(title, **cells, measured=measured.failure, holds=False)
                continue
            value, target = figure(name, measured, frames), wanted.get(name, {}).get(frames)
            cells |= {"measured": value, **beside_bound(name, frames, value, bound(text, config, device))}
            cells |= {"target": target, "published": published.get(name, {}).get(frames)}
            if target is not None:
                cells["holds"] = value is not None and value <= target
            memory = figure("memory", measured, frames)
            cells |= {"compile_s": measured.compile_seconds, "memory_GB": memory}
            cells["memory_target"] = wanted.get("memory", {}).get(frames) if name == "aggregator" else None
            lines.row(title, **cells)


def _measured(name: str, case: Case) -> tuple[Measured, str]:
    """Measure a program; return also its optimised text, empty where memory ran out before."""
    texts = [""]

    def measure() -> dict[str, Measured]:
        function, arguments = _PROGRAMS[name](case)
        read = lambda compiled: texts.append(compiled.as_text() or "")  # noqa: E731
        return {"": measure_program(function, arguments, range(_REPEATS), read)}

    return without_memory(measure)[""], texts[-1]


def figure(name: str, measured: Measured, frames: int) -> float | None:
    """Return a measured figure in the unit of its heading, or its "memory"; None: unknown.

    Memory is beyond weights and inputs: the device's own count, or XLA's analysis where there is none.
    """
    if name == "memory":
        size = measured.xla_bytes if measured.device_bytes is None else measured.device_bytes
        return None if size is None else size / 1e9
    return None if measured.median is None else _scale(name, frames) * measured.median


def beside_bound(name: str, frames: int, value: float | None, least: float | str) -> dict[str, Cell]:
    """Return the bound in the unit of its heading and the time over it; of an unknown one, why."""
    if isinstance(least, str):
        return {"bound": least}
    shown = _scale(name, frames) * least
    return {"bound": shown, "over_bound": None if value is None else value / shown}


def _scale(name: str, frames: int) -> float:
    """Return what makes seconds the unit of a heading."""
    return {"aggregator": 1e3, "depth-head": 1e3 / frames, "two-passes": 1.0}[name]


def full_frame(size: Size) -> tuple[int, int]:
    """Return height and width: those of the targets for the full model."""
    height, width = FRAME if size == "full" else (None, None)
    return frame_size(size, config_of(size), height, width)
