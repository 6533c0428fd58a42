"""Time of a training step, beside an earlier checkout of the package: python -m benchmarks training-step."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.suite import work
from benchmarks.suite.ceilings import Ceilings, Rounds
from benchmarks.suite.report import Sheet, console, describe, machine, number, write_json
from vggtjax.errors import InputError
from vggtjax.training.recipe import Recipe, read_recipe
from vggtjax.training.workers import check_workers

_ROOT = Path(__file__).resolve().parents[1]
_WORKER = Path(__file__).with_name("training_step_worker.py")
_PARTS = ("render", "gradient", "update")

Answer = dict[str, Any]


class _Side(NamedTuple):
    """One of the compared processes: the package, the XLA devices of its CPU, the workers that it trains with."""

    package: str
    devices: int
    workers: int


def training_step(
    *,
    recipe: Path = _ROOT / "docs" / "embedded" / "5-four-frames.json",
    before: Path | None = None,
    devices: tuple[int, ...] = (1, 2),
    workers: int = 2,
    steps: int = 2,
    rounds: int = 5,
    out: Path | None = None,
) -> None:
    """Time the parts of a training step, against the ceilings of the machine measured around every round.

    The first phase of the recipe counts, with its height and width and its first number of frames. The products of
    forward and backward pass are counted from the shapes: three times those of the forward pass. With `before`, both
    checkouts take turns, and their losses on the same clips are compared first. Each of them sets its process up as its
    own `vggtjax train` does.

    Args:
        recipe: JSON file with the recipe.
        before: folder of another checkout, whose package `vggtjax` is measured too.
        devices: numbers of XLA devices that a CPU is divided into; the clips are spread over them.
        workers: of one more side, whose clips are spread over so many processes; 1 for no such side.
        steps: steps of a round.
        rounds: timed rounds, after a warm-up.
        out: JSON file for the figures of every round.
    """
    if not devices or min(*devices, workers, steps, rounds) < 1:
        given = f"{devices}, {workers}, {steps} and {rounds}"
        raise InputError(f"devices, workers, steps and rounds are {given}; expected at least 1")
    if before is not None and not (before / "vggtjax" / "training").is_dir():
        raise InputError(f"{before} has no vggtjax/training; expected a checkout of this package")
    chosen = read_recipe(recipe)
    check_workers(chosen, workers)
    phase = chosen.stages[0]
    grid = phase.height // chosen.model.patch_size, phase.width // chosen.model.patch_size
    frames = phase.frames[0]
    flop = 3 * phase.batch * _forward_flop(chosen, frames, grid)
    folders = {"now": _ROOT} | ({} if before is None else {"before": before.resolve()})
    sides = {_Side(name, count, 1): folder for count in devices for name, folder in folders.items()}
    if workers > 1:
        sides[_Side("now", 1, workers)] = _ROOT
    best = _Side("now", 1, workers) if workers > 1 else _Side("now", devices[0], 1)
    screen, ceiling = console(), Rounds(rounds, Ceilings(chosen.model, grid, "float32"))
    processes: dict[_Side, _Worker] = {}
    try:
        with screen.status("compile"):
            for side, folder in sides.items():
                processes[side] = _Worker(folder, recipe.resolve(), side)
                processes[side].ask(steps=1)
        losses = {side: process.ask(losses=True)["losses"] for side, process in processes.items()}
        runs: dict[_Side, list[Answer]] = {side: [] for side in sides}
        with screen.status("measure"):
            for turn in ceiling:
                for side in sides if turn % 2 else reversed(sides):
                    runs[side].append(processes[side].ask(steps=steps))
    finally:
        for process in processes.values():
            process.close()
    rates = [rate["linear"] for rate in ceiling.rates]
    rows = [_row(side, runs[side], phase.batch * frames, flop, rates) for side in sides]
    headings = (*_Side._fields, *_PARTS, "step (s)", "frames/s", "GFLOP/s", "of the ceiling", "render share")
    title = f"{phase.batch} clips of {frames} frames, {phase.width} x {phase.height}, {flop / 1e9:.0f} GFLOP a step"
    Sheet(title, headings, rows).show(screen)
    figures = [{**side._asdict(), "losses": losses[side], "runs": runs[side]} for side in sides]
    report = {"recipe": chosen.name, "flop": flop, "ceilings": rates, "sides": figures}
    if before is not None:
        old = {count: _Side("before", count, 1) for count in devices}
        apart = max(_apart(found, losses[old[devices[0]]]) for found in losses.values())
        screen.print(f"losses differ by at most {apart:.1e}")
        report |= {"losses_apart": apart, "best": best._asdict()}
        for count in devices:
            pairs = zip(runs[old[count]], runs[best], strict=True)
            ratio = float(np.median([_seconds(a) / _seconds(b) for a, b in pairs]))
            screen.print(
                f"{ratio:.2f} times the frames a second of before: then devices {count}, "
                f"now devices {best.devices}, workers {best.workers}"
            )
            report[f"ratio_to_{count}"] = ratio
    here = machine()
    screen.print(describe(here), highlight=False)
    if out is not None:
        write_json(out, {"machine": here, **report})


class _Worker:
    """A process that takes training steps with the package of one checkout."""

    def __init__(self, folder: Path, recipe: Path, side: _Side) -> None:
        devices = side.devices
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
        self._process: Any = subprocess.Popen(
            [sys.executable, str(_WORKER), str(recipe), str(side.workers)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=os.environ | {"PJRT_NPROC": str(2 * devices), "PYTHONPATH": str(folder), "XLA_FLAGS": flags},
        )

    def ask(self, **task: Any) -> Answer:
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"the process with the package in {self._process.args[1]} ended; its output is above")
        return json.loads(line)

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def _forward_flop(recipe: Recipe, frames: int, grid: tuple[int, int]) -> float:
    config, losses = recipe.model, recipe.losses
    parts = [*work.backbone(config, frames, grid), *work.alternating(config, frames, grid)]
    parts += work.camera_head(config, frames)
    for weight in (losses.depth, losses.points):
        parts += work.depth_head(config, frames, grid) if weight else []
    return work.flop(parts)


def _seconds(run: Answer) -> float:
    return sum(run[part] for part in _PARTS)


def _apart(losses: dict[str, float], others: dict[str, float]) -> float:
    """Return the largest difference of two losses, relative to the second."""
    return max(abs(losses[name] - other) / abs(other) for name, other in others.items())


def _row(side: _Side, runs: list[Answer], frames: int, flop: float, ceilings: list[float]) -> tuple[str, ...]:
    parts = [float(np.median([run[part] for run in runs])) for part in _PARTS]
    seconds = [_seconds(run) for run in runs]
    rate = flop / float(np.median([run["gradient"] for run in runs]))
    share = float(np.median([flop / run["gradient"] / ceiling for run, ceiling in zip(runs, ceilings, strict=True)]))
    median = float(np.median(seconds))
    return (
        *map(str, side),
        *map(number, parts),
        number(median),
        number(frames / median),
        number(rate / 1e9),
        f"{100 * share:.0f} %",
        f"{100 * parts[0] / median:.0f} %",
    )
