"""Programs compiled for accelerators that are not there, counted: python -m benchmarks accelerator."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import Progress, TaskID

from benchmarks.accelerator.programs import PROGRAMS, Compiled, Setup, compile_programs
from benchmarks.accelerator.targets import TARGETS, target
from benchmarks.suite.cases import DType, Size, check_counts, config_of, frame_size
from benchmarks.suite.report import Sheet, console, number
from vggtjax.config import Precision
from vggtjax.errors import InputError, check_choice
from vggtjax.storage.writing import writing

_FULL_FRAME = (392, 518)  # of published figures
_NOTE = (
    "Bounds, not times: each kernel takes at least the longer of its products and of its bytes, and 2 us. Products "
    "reach 80 % of the data sheet's peak on tensor cores, 90 % in float32. FLOP: what the arithmetic needs, at the "
    "rate of the blocks' type; ratio: bound over FLOP; temporary: memory beside inputs and outputs. Nothing was run."
)


def accelerator(
    *,
    targets: tuple[str, ...] = ("h100",),
    programs: tuple[str, ...] = ("plain pass", "first pass"),
    size: Size = "full",
    frames: tuple[int, ...] = (8, 50, 200),
    height: int | None = None,
    width: int | None = None,
    dtype: DType = "bfloat16",
    precision: Precision = "tf32",
    devices: int = 1,
    top: int = 0,
    most: float | None = None,
    out: Path | None = None,
) -> None:
    """Compile the programs of a reconstruction for accelerators that are not there, and count their kernels.

    Needs the compilers: pip install -e '.[accelerator]', or make accelerator.

    Args:
        targets: names of accelerators, or all.
        programs: their names, or all.
        size: of the model; full is VGGT-1B.
        frames: numbers of frames.
        height: of a frame, in pixels; 392 for full by default, the model's own for the others.
        width: of a frame, in pixels; 518 for full by default, the model's own for the others.
        dtype: type of the products in the blocks.
        precision: of the heads' products.
        devices: 1, 8, or for a TPU 4: frames are in equal shares on all.
        top: how many kernels of each program to list.
        most: fail if a program needs more temporary memory and outputs than so many GB.
        out: JSON file for the results.
    """
    names = _chosen("targets", targets, tuple(TARGETS))
    wanted = _chosen("programs", programs, PROGRAMS)
    check_counts(frames)
    if devices not in (1, 4, 8):
        raise InputError(f"devices is {devices}; expected 1, 4 or 8")
    full = size == "full"
    shape = frame_size(size, config_of(size), height or (_FULL_FRAME[0] if full else None), width)
    screen = console()
    found: list[dict[str, Any]] = []
    for name in names:
        setups = [Setup(target(name), config_of(size), count, *shape, dtype, precision, devices) for count in frames]
        rows = _compiled(setups, wanted, screen)
        title = f"{TARGETS[name].name} x {devices}, {size}, {shape[1]} x {shape[0]} pixels, {dtype}, heads {precision}"
        Sheet(title, _HEADINGS, [_row(setup, compiled) for setup, compiled in rows]).show(screen)
        for setup, compiled in rows if top else []:
            _kernels(setup, compiled, top).show(screen)
        found += [_record(name, setup, compiled) for setup, compiled in rows]
        for setup, compiled in rows:
            needed = (compiled.temporary + compiled.outputs) / 1e9
            if most is not None and needed > most:
                raise InputError(
                    f"{compiled.name} of {setup.frames} frames on {name} needs {needed:.2f} GB of temporary memory and "
                    f"outputs; expected at most {most:g}"
                )
    screen.print(_NOTE)
    if out is not None:
        with writing(out) as temporary:
            temporary.write_text(json.dumps({"note": _NOTE, "jax": jax.__version__, "programs": found}, indent=1))


def _compiled(setups: Sequence[Setup], wanted: Sequence[str], screen: Console) -> list[tuple[Setup, Compiled]]:
    """Return the programs of every setup, with a line about the one that is compiled."""
    rows: list[tuple[Setup, Compiled]] = []
    with Progress(console=screen, transient=True) as progress:
        task = progress.add_task("", total=len(setups) * len(wanted))
        for setup in setups:
            told = partial(_tell, progress, task, f"{setup.target.name}, {setup.frames} frames")
            rows += [(setup, compiled) for compiled in compile_programs(setup, wanted, told)]
    return rows


def _tell(progress: Progress, task: TaskID, where: str, program: str) -> None:
    progress.update(task, description=f"{where}: {program}", advance=1)


_HEADINGS = (
    "program", "frames", "compile s", "kernels", "bound ms", "FLOP ms", "ratio", "bytes ms",
    "temporary GB", "outputs GB", "inputs GB", "calls", "collectives",
)  # fmt: skip


def at_peak(setup: Setup, compiled: Compiled) -> float | None:
    """Return the milliseconds that the arithmetic takes, all of it in the type of the blocks; None: unknown."""
    return None if compiled.needed is None else 1e3 * compiled.needed / setup.target.rate(setup.dtype)


def _row(setup: Setup, compiled: Compiled) -> tuple[str, ...]:
    counted, least = compiled.counted, at_peak(setup, compiled)
    return (
        compiled.name,
        str(setup.frames),
        f"{compiled.seconds:.1f}",
        f"{counted.launches:.0f}",
        number(1e3 * counted.seconds),
        number(least),
        "" if least is None else f"{1e3 * counted.seconds / least:.2f}",
        number(1e3 * counted.bytes / setup.target.bandwidth),
        *(f"{size / 1e9:.2f}" for size in (compiled.temporary, compiled.outputs, compiled.inputs)),
        str(sum(counted.library_calls.values())),
        ", ".join(f"{times} {name}" for name, times in sorted(counted.collectives.items())),
    )


def _kernels(setup: Setup, compiled: Compiled, top: int) -> Sheet:
    rows = [
        (
            kernels.origin[-100:],
            kernels.opcode,
            number(1e3 * kernels.seconds),
            f"{kernels.launches:.0f}",
            number(kernels.bytes / 1e9),
            number(sum(kernels.flop.values()) / 1e12),
            "/".join(sorted(kernels.flop)),
        )
        for kernels in compiled.counted.longest(top)
    ]
    headings = ("kernel", "operation", "ms", "times", "GB", "TFLOP", "type")
    return Sheet(f"{compiled.name}, {setup.frames} frames", headings, rows)


def _record(name: str, setup: Setup, compiled: Compiled) -> dict[str, Any]:
    counted = compiled.counted
    facts = dataclasses.asdict(setup) | {"target": name}
    del facts["config"]
    return facts | {
        "program": compiled.name,
        "compile_seconds": compiled.seconds,
        "kernels": counted.launches,
        "bound_seconds": counted.seconds,
        "needed_flop": compiled.needed,
        "flop": dict(counted.flop),
        "bytes": counted.bytes,
        "temporary_bytes": compiled.temporary,
        "output_bytes": compiled.outputs,
        "input_bytes": compiled.inputs,
        "library_calls": dict(counted.library_calls),
        "collectives": dict(counted.collectives),
        "loops_of_unknown_length": counted.unknown_loops,
    }


def _chosen(name: str, given: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the given names, or all. Raises InputError for unknown ones."""
    if tuple(given) == ("all",):
        return tuple(known)
    for value in given:
        check_choice(name, value, tuple(known))
    return tuple(given)
