"""The command `vggtjax train`. Does not import jax before it is needed."""

from __future__ import annotations

import time
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.errors import InputError, check_extra
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.report import Report
from vggtjax.storage.process import run_in_calling_thread
from vggtjax.storage.writing import check_file, check_free
from vggtjax.training.options import RunOptions

if TYPE_CHECKING:
    from vggtjax.training.loop import Status

_MODEL, _RECIPE = "model.safetensors", "recipe.json"  # of a run, beside its metrics
_WRITTEN = (_MODEL, _RECIPE, "metrics.csv", "metrics.png")
_LINE_SECONDS = 20.0  # between lines of progress


def train(
    recipe: Path,
    out: Path,
    *,
    init: Annotated[str | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="")] = None,
    steps: InWords[int | None] = None,
    options: Annotated[RunOptions, tyro.conf.arg(name="run", help="")] = RunOptions(),  # noqa: B008 (frozen)
) -> None:
    """Train a model on generated scenes, or resume an interrupted run.

    Args:
        recipe: JSON file with the recipe.
        out: folder for the model, checkpoints and metrics; an existing run in it is resumed.
        init: a model to start from: "demo", a .safetensors, a PyTorch checkpoint, or a hub id; random parameters by
            default. The recipe's image size, cues and number of masked pairs replace those of the model, and the
            recipe's new pairs of blocks (start.new_pairs) are added.
        steps: total number of steps; phases, warm-up and decay keep their shares. The recipe's own by default.
        options: how the run logs, saves and ends.
    """
    check_extra("training", "train", "orbax", "matplotlib")
    check_file(out / _MODEL, overwrite=True, sources=[] if init is None else [Path(init), Path(init) / _MODEL])
    if steps is not None:  # else it is written as it is
        check_file(out / _RECIPE, overwrite=True, sources=[recipe])
    report = Report()
    with report.running():
        with report.stage("prepare"):
            run_in_calling_thread()
            from vggtjax.training.loop import train as run
            from vggtjax.training.recipe import read_recipe

            chosen = read_recipe(recipe)
            check_free(out, _WRITTEN, replaced=_is_recipe(out / _RECIPE), what="training run")
            if steps is not None:
                chosen = chosen.with_steps(steps)
        model = None
        if init is not None:
            with report.stage("load model") as progress:
                from vggtjax.pipeline.pretrained.load import load_weights

                model = load_weights(init, config=chosen.initial_model, progress=progress)
        report.note("the first step with each phase and clip size compiles, which takes seconds to minutes")
        with report.stage("train") as advance:
            shown = time.perf_counter()

            def show(status: Status) -> None:
                nonlocal shown
                advance(status.step, status.total_steps)
                if status.metrics and time.perf_counter() - shown >= _LINE_SECONDS:
                    report.line(_line(status))
                    shown = time.perf_counter()

            outcome = run(chosen, out, init=model, options=options, progress=show)
    done, total = int(outcome.state.step), chosen.total_steps
    report.table(
        {
            "steps": f"{done} of {total}" + ("" if outcome.finished else "; the same command resumes the run"),
            "skipped": f"{int(outcome.state.skipped)} steps whose loss or gradient was not finite",
            "model": outcome.model,
            "metrics": f"{out / 'metrics.csv'}, {out / 'metrics.png'}",
        }
    )


def _is_recipe(path: Path) -> bool:
    from vggtjax.training.recipe import read_recipe

    try:
        read_recipe(path)
    except InputError:
        return False
    return True


def _line(status: Status) -> str:
    text = f"step {status.step} of {status.total_steps}, phase {status.phase + 1}"
    if "loss" in status.metrics:
        text += f", loss {status.metrics['loss']:.4g}"
    if status.seconds_left is not None:
        text += f", {timedelta(seconds=round(status.seconds_left))} left"
    return text
