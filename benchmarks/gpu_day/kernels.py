"""The longest kernels of both passes, from a profile; of the aggregator at small size."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax

from benchmarks.gpu_day.lines import Lines
from benchmarks.gpu_day.speed import full_frame
from benchmarks.suite.cases import Case, Size, load
from benchmarks.suite.measure import timed
from benchmarks.suite.workloads import aggregator, two_passes
from vggtjax.errors import InputError

_TOLD = 10
_RUNS = 2


def kernels(size: Size, lines: Lines) -> None:
    """Run them under jax's profiler, and list the kernels that take longest."""
    config, params = load(size)
    program, frames, dtype = (aggregator, 2, "float32") if size == "tiny" else (two_passes, 8, "bfloat16")
    function, arguments = program(Case(size, config, params, frames, *full_frame(size), dtype))
    compiled = jax.jit(function).lower(*arguments).compile()
    jax.block_until_ready(compiled(*arguments))
    with TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            seconds = sum(timed(lambda: jax.block_until_ready(compiled(*arguments)))[1] for _ in range(_RUNS))
        (path,) = Path(folder).rglob("*.xplane.pb")
        times = kernel_times(jax.profiler.ProfileData.from_file(str(path)))
    if not times:
        raise InputError("the profile has no kernels; is the profiler allowed on this machine?")
    total = sum(sum(of_kernel) for of_kernel in times.values())
    lines.facts(runs=_RUNS, frames=frames, seconds_of_a_run=seconds / _RUNS, kernel_seconds_of_a_run=total / _RUNS)
    ranked = sorted(times.items(), key=lambda item: -sum(item[1]))
    title = f"{_TOLD} longest kernels, {program.__name__.replace('_', ' ')} of {frames} frames"
    for name, of_kernel in ranked[:_TOLD]:
        share = f"{sum(of_kernel) / total:.1%}"
        row = {"calls": len(of_kernel) // _RUNS, "ms": 1e3 * sum(of_kernel) / _RUNS, "share": share}
        lines.row(title, kernel=name[:90], **row)
    rest = 1 - sum(sum(of_kernel) for _, of_kernel in ranked[:_TOLD]) / total
    lines.row(title, kernel=f"{max(len(ranked) - _TOLD, 0)} others", share=f"{rest:.1%}")


def kernel_times(profile: Any) -> dict[str, list[float]]:
    """Return the seconds of every call, by kernel: of the streams of GPUs and TPUs' operations, or of a CPU's."""
    times: dict[str, list[float]] = defaultdict(list)
    devices = [plane for plane in profile.planes if plane.name.startswith("/device:") and "CUSTOM" not in plane.name]
    for plane in devices or [plane for plane in profile.planes if plane.name.startswith("/host:CPU")]:
        for line in plane.lines:
            if devices and not (line.name.startswith("Stream") or line.name == "XLA Ops"):
                continue
            if line.name == "XLA Ops" and any(other.name.startswith("Stream") for other in plane.lines):
                continue  # of a GPU, the same once more
            for event in line.events:
                if devices or any(name == "hlo_op" for name, _ in event.stats):
                    times[_kind(event.name)].append(event.duration_ns / 1e9)
    return dict(times)


def _kind(name: str) -> str:
    """Return a kernel's name without the number of its instance."""
    return re.sub(r"(\.\d+)+$", "", name)
