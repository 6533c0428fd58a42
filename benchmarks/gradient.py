"""The cost of a gradient compared with its two passes: python -m benchmarks gradient."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from benchmarks.suite.cases import Case, DType, Size, check_counts, frame_size, load
from benchmarks.suite.measure import Measured, compiling_anew, measure_program, without_memory
from benchmarks.suite.report import Sheet, console, describe, machine, number, write_json
from vggtjax.learning.soft import reconstruct_softly, soft_masking
from vggtjax.method.fusion_family import identity

_FIRST = "both passes and fusion"


def gradient(
    *,
    size: Size = "demo",
    weights: Path | None = None,
    frames: tuple[int, ...] = (2, 8),
    height: int | None = None,
    width: int | None = None,
    dtype: DType = "float32",
    masking: bool = True,
    repeats: int = 3,
    out: Path | None = None,
) -> None:
    """Time both passes with soft masks, and their gradients with respect to the fusion's and the masking's parameters.

    Args:
        size: of the model.
        weights: a converted checkpoint for size full.
        frames: numbers of frames.
        height: of a frame, in pixels; the size's own by default.
        width: of a frame, in pixels; the size's own by default.
        dtype: type of the products in the blocks.
        masking: also measure the gradient with respect to the masking, through the second pass.
        repeats: timed runs of each, after a warm-up.
        out: JSON file for the results.
    """
    check_counts(frames, repeats)
    config, params = load(size, weights)
    shape = frame_size(size, config, height, width)
    fusion, soft = identity(), soft_masking(config, temperature=0.1)

    def loss(fusion, soft, params, images, remat: bool):
        made = reconstruct_softly(params, images, config, soft, fusion, compute_dtype=dtype, remat=remat)
        return made.depth.mean() + made.log_precision.mean()

    def passes(fusion, soft, params, images):
        return loss(fusion, soft, params, images, False)

    def by_fusion(fusion, soft, params, images):
        return jax.value_and_grad(loss)(fusion, soft, params, images, False)

    def by_masking(fusion, soft, params, images):
        return jax.value_and_grad(loss, argnums=(0, 1))(fusion, soft, params, images, True)

    programs: dict[str, Any] = {_FIRST: passes, "gradient by the fusion": by_fusion}
    if masking:
        programs["gradient by fusion and masking, rematerialised"] = by_masking
    screen, rows, found = console(), [], []
    with compiling_anew(), screen.status("compile and run"):
        for count in frames:
            images = Case(size, config, params, count, *shape, dtype).images()
            base: Measured | None = None
            for name, function in programs.items():
                arguments = (fusion, soft, params, images)
                made = without_memory(lambda f=function, a=arguments: {"": measure_program(f, a, range(repeats))})[""]
                base = made if name == _FIRST else base
                found.append({"program": name, "frames": count, **_plain(made)})
                rows.append((str(count), name, *_cells(made, base)))
    here = machine()
    headings = ("frames", "program", "seconds", "ratio", "XLA (MB)", "ratio", "host (MB)", "ratio", "failure")
    Sheet(f"{size}, {shape[1]} x {shape[0]} pixels, {dtype}", headings, rows).show(screen)
    screen.print(describe(here), highlight=False)
    if out is not None:
        write_json(out, {"machine": here, "size": size, "height": shape[0], "width": shape[1], "programs": found})


def _cells(made: Measured, base: Measured | None) -> tuple[str, ...]:
    cells = []
    for name, unit in (("median", 1.0), ("xla_bytes", 1e6), ("host_bytes", 1e6)):
        value, first = getattr(made, name), None if base is None else getattr(base, name)
        cells.append("-" if value is None else number(value / unit))
        cells.append("-" if value is None or not first else f"{value / first:.2f}")
    return (*cells, made.failure)


def _plain(made: Measured) -> dict[str, Any]:
    return {"seconds": list(made.seconds), "xla_bytes": made.xla_bytes, "host_bytes": made.host_bytes}
