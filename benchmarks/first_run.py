"""From the start of a process to the first depth, with an empty cache: python -m benchmarks first-run."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from vggtjax.errors import InputError
from vggtjax.pretrained.embedded import demo_clip

Case = Literal["demo", "picture", "script", "full"]
_ROOT = Path(__file__).parents[1]
_FULL_SIZE = (518, 294)  # width and height
# A line on standard error when depth is there: of the last stage before it, or of the script.
_DEPTH = ("assemble ", "depth")
_SCRIPT = """
import sys
import vggtjax
model = vggtjax.load_model("demo")
result = vggtjax.reconstruct(model, vggtjax.load_clip(sys.argv[1], size=64, patch=model.config.patch_size), size=64)
print("depth", result.depth.shape, file=sys.stderr, flush=True)
"""


class Run(NamedTuple):
    """How long a process took to its first depth, in seconds: on the clock, and of all processors."""

    clock: float
    processors: float


def first_run(
    *,
    before: Path,
    cases: tuple[Case, ...] = ("demo", "picture", "script"),
    weights: Path | None = None,
    frames: int = 2,
    repeats: int = 2,
    warm: bool = False,
) -> None:
    """Compare this code with other code: each run is a process of its own with an empty cache, in turn.

    A process is stopped when it has its first depth. The best of the repeats counts, for the clock and for the seconds
    of all processors, which other programs on the machine change less.

    Args:
        before: root of other code of this project, such as a folder that `git worktree add` made.
        cases: demo, `vggtjax demo`; picture, `vggtjax reconstruct` of one picture with the embedded model; script, a
            Python script that calls `vggtjax.reconstruct` for the demo's pictures, and keeps nothing; full, `vggtjax
            reconstruct` with `weights`.
        weights: checkpoint of the full size, as `vggtjax convert` wrote it.
        frames: pictures of the case full.
        repeats: runs of each case and side.
        warm: run each process once before with the same cache, which it then finds.
    """
    if not (before / "vggtjax").is_dir():
        raise InputError(f"before is {before}, without a folder vggtjax; expected the root of other code")
    if "full" in cases and weights is None:
        raise InputError("the case full has no weights; give --weights a checkpoint that vggtjax convert wrote")
    if repeats < 1 or frames < 1:
        raise InputError(f"repeats is {repeats} and frames is {frames}; expected at least 1")
    sides = {"before": before.resolve(), "after": _ROOT}
    console = Console()
    table = Table(title="from the start of a process to its first depth", title_justify="left")
    for column in ("case", "before", "after", "ratio", "processors before", "after", "ratio"):
        table.add_column(column, justify="left" if column == "case" else "right")
    with TemporaryDirectory() as folder:
        runs: dict[tuple[str, str], list[Run]] = {}
        commands = {case: _command(case, Path(folder), weights, frames) for case in cases}
        steps = [*product(range(repeats), cases, sides)]
        for repeat, case, side in track(steps, "runs", console=console):
            cache = Path(folder) / f"{case}-{side}-{repeat}"
            if warm:
                _run(commands[case], sides[side], cache)
            run = _run(commands[case], sides[side], cache)
            runs.setdefault((case, side), []).append(run)
            console.print(f"{case} {side}: {run.clock:.2f} s, {run.processors:.2f} s of all processors")
    for case in cases:
        table.add_row(case, *(cell for field in Run._fields for cell in _cells(runs, case, field)))
    console.print(table)


def _cells(runs: dict[tuple[str, str], list[Run]], case: str, field: str) -> Iterator[str]:
    old, new = (min(getattr(run, field) for run in runs[case, side]) for side in ("before", "after"))
    yield from (f"{old:.1f} s", f"{new:.1f} s", f"{new / old:.2f}")


def _command(case: Case, folder: Path, weights: Path | None, frames: int) -> list[str]:
    """Return the arguments of Python for a case, whose pictures are written to a folder."""
    pictures = folder / f"pictures of {case}"
    _write_pictures(pictures, {"picture": 1, "full": frames}.get(case), _FULL_SIZE if case == "full" else None)
    out = ["--out", str(folder / f"result of {case}")]
    reconstruct = ["-m", "vggtjax", "reconstruct", str(pictures), "--model"]
    return {
        "demo": ["-m", "vggtjax", "demo", *out],
        "picture": [*reconstruct, "demo", *out],
        "script": ["-c", _SCRIPT, str(pictures)],
        "full": [*reconstruct, str(weights and weights.resolve()), *out],
    }[case]


def _write_pictures(folder: Path, count: int | None, size: tuple[int, int] | None) -> None:
    folder.mkdir()
    for number, pixels in enumerate(demo_clip().images[:count]):
        picture = Image.fromarray(np.rint(255 * pixels).astype(np.uint8))
        (picture.resize(size) if size else picture).save(folder / f"{number:04}.png")


def _run(arguments: list[str], root: Path, cache: Path) -> Run:
    """Run Python with the code of a root, and stop it at its first depth."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"VGGTJAX_CACHE": str(cache), "PYTHONPATH": str(root)}
    started, lines, clock = time.perf_counter(), [], None
    process = subprocess.Popen(
        [sys.executable, *arguments],
        cwd=root,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    for line in process.stderr:
        lines.append(line)
        if line.startswith(_DEPTH):
            clock = time.perf_counter() - started
            break
    process.kill()
    process.stderr.close()
    _, _, usage = os.wait4(process.pid, 0)
    if clock is None:
        raise InputError(f"{shlex.join(arguments[:4])} with {root} had no depth: {''.join(lines[-5:])}")
    return Run(clock, usage.ru_utime + usage.ru_stime)
