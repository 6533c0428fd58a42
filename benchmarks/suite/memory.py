"""Growth of memory with frames, by XLA's own analysis without a run: python -m benchmarks memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import Progress

from benchmarks.suite.cases import DType, Size, check_counts, config_of, frame_size
from benchmarks.suite.measure import analysed, compiling_anew
from benchmarks.suite.report import Sheet, console, describe, machine, number, write_json
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError, check_extra
from vggtjax.method.passes import first_pass, run_passes
from vggtjax.network.aggregator import SPECIAL_TOKENS
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.model import forward, parameter_shapes
from vggtjax.network.precision import Compute


def _first_with_cues(params, images, config: VGGTConfig, compute_dtype: str):
    return first_pass(params, ClipBatch(images), config, compute=Compute(compute_dtype))


_PROGRAMS = {"plain pass": forward, "first pass with cues": _first_with_cues, "both passes": run_passes}


def memory(
    *,
    frames: tuple[int, ...] = (2, 4, 8, 16, 32),
    size: Size = "full",
    height: int | None = None,
    width: int | None = None,
    dtype: tuple[DType, ...] = ("float32",),
    out: Path | None = None,
    plots: Path | None = None,
) -> None:
    """Compile passes for several numbers of frames, and fit the growth of temporary and output memory.

    Args:
        frames: numbers of frames, at least two.
        size: of the model; no weights are needed.
        height: of a frame, in pixels; 294 for full by default.
        width: of a frame, in pixels; 518 for full by default.
        dtype: types of the products in the blocks; one or both.
        out: JSON file for the results.
        plots: folder for memory.png.
    """
    check_counts(frames)
    if len(set(frames)) < 2:
        raise InputError(f"frames is {list(frames)}; expected at least two different numbers, to fit a slope")
    if plots is not None:
        check_extra("plotting", "train", "matplotlib")
    config = config_of(size)
    shape = frame_size(size, config, height, width)
    params = parameter_shapes(config)
    screen, found = console(), []
    with compiling_anew(), Progress(console=screen, transient=True) as progress:
        task = progress.add_task("compile", total=len(dtype) * len(_PROGRAMS) * len(frames))
        for kind in dict.fromkeys(dtype):
            for name, function in _PROGRAMS.items():
                sizes = []
                for count in frames:
                    progress.update(task, description=f"{name}, {kind}, {count} frames")
                    images = jax.ShapeDtypeStruct((1, count, *shape, 3), jnp.float32)
                    sizes.append(_compiled_bytes(function, params, images, config, kind))
                    progress.advance(task)
                line = {"program": name, "dtype": kind, "frames": list(frames), "bytes": sizes}
                found.append(line | {"bytes_per_frame": slope(frames, sizes)})
    here = machine()
    title = f"{size}, {shape[1]} x {shape[0]} pixels, temporary and output memory as compiled for {here['platform']}"
    headings = ("program", "dtype", *(f"{count} frames (MB)" for count in frames), "MB per frame")
    rows = [
        (line["program"], line["dtype"], *(number(v / 1e6) for v in (*line["bytes"], line["bytes_per_frame"])))
        for line in found
    ]
    Sheet(title, headings, rows).show(screen)
    screen.print(describe(here), highlight=False)
    if out is not None:
        write_json(out, {"machine": here, "size": size, "height": shape[0], "width": shape[1], "programs": found})
    if plots is not None:
        from benchmarks.suite.pictures import plot_growth

        tokens = SPECIAL_TOKENS + shape[0] * shape[1] // config.patch_size**2
        kept = 4 * config.depth * tokens * config.tap_dim
        lines = {
            f"{row[0]}, {row[1]}: {row[-1]} MB a frame": (frames, line["bytes"])
            for row, line in zip(rows, found, strict=True)
        }
        plot_growth(plots / "memory.png", lines, kept, f"{title}\n{describe(here)}")


def slope(frames: Sequence[int], sizes: Sequence[float]) -> float:
    """Return the least-squares growth per frame."""
    return float(np.polyfit(np.asarray(frames, float), np.asarray(sizes, float), 1)[0])


def _compiled_bytes(function: Any, params, images, config: VGGTConfig, dtype: DType) -> int:
    def run(params, images):
        return function(params, images, config, compute_dtype=dtype)

    temp, output = analysed(jax.jit(run).lower(params, images).compile())
    if temp is None or output is None:
        raise InputError(f"jax gives no analysis of memory on {jax.default_backend()}; run on another platform")
    return temp + output
