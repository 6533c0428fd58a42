"""The training loop: batches, steps, metrics, checkpoints; an interrupted run goes on where it was."""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from vggtjax.checkpoint import DType
from vggtjax.network.layers import Params
from vggtjax.training.data import make_batch as make_scene_batch
from vggtjax.training.devices import placement
from vggtjax.training.metrics import Row
from vggtjax.training.objective import init_probes as init_scene_probes
from vggtjax.training.objective import objective as scene_objective
from vggtjax.training.recipe import Recipe, Stage
from vggtjax.training.run import Run
from vggtjax.training.state import Metrics, Objective, TrainingState, apply_gradient, loss_and_gradient

_AHEAD = 2  # steps that the host may prepare while the device computes
_TIMED = 2  # steps of each interval in which rendering is timed by itself
_PLOT_SECONDS = 180.0

# Apart, so that the optimiser, whose shapes are always the same, is compiled once and not for every size of batch.
_loss_and_gradient = jax.jit(loss_and_gradient, static_argnums=(2, 3))
_apply_gradient = jax.jit(apply_gradient, static_argnums=3, donate_argnums=0)

logger = logging.getLogger(__name__)


class Status(NamedTuple):
    """How far a run is; given to the progress callback after every row of metrics, and at its start and end."""

    step: int
    total_steps: int
    stage: int
    seconds: float  # spent training, all runs together
    seconds_left: float | None  # at the pace of this run, or until it is to stop; None while that is not known
    metrics: Row  # the last row


class Outcome(NamedTuple):
    """What a run leaves: its state, whether all steps are done, and the exported model."""

    state: TrainingState
    finished: bool
    model: Path


def train(
    recipe: Recipe,
    out: str | Path,
    *,
    init: Params | None = None,
    progress: Callable[[Status], object] | None = None,
    stop_after: float | None = None,
    log_every: int = 50,
    checkpoint_seconds: float = 600.0,
    export_dtype: DType = "float32",
    textures: Any = None,
    make_batch: Callable[..., Any] = make_scene_batch,
    init_probes: Callable[..., Params] = init_scene_probes,
    objective: Objective = scene_objective,
) -> Outcome:
    """Train a model, or go on from the newest checkpoint in `out`.

    The batch of a step depends on the recipe and the step alone, so a run that was interrupted gives the numbers of one
    that was not (on a GPU as far as its sums have a fixed order: XLA_FLAGS=--xla_gpu_deterministic_ops=true).
    SIGINT and SIGTERM end the run after the step at hand, with a checkpoint; a second SIGINT ends it at once.

    Args:
        recipe: what to train, on what, and how.
        out: folder for recipe.json, metrics.csv, metrics.png, checkpoints/ and model.safetensors, which holds the
            averaged parameters.
        init: the model's parameters to start from; None for random ones. Not read when there is a checkpoint.
        progress: called with a Status.
        stop_after: seconds after which the run ends early, with a checkpoint; None for never.
        log_every: steps that a row of metrics averages over.
        checkpoint_seconds: time between checkpoints.
        export_dtype: of the parameters in model.safetensors.
        textures: what `make_batch` takes; None for those of the training split.
        make_batch: (key, textures, stage, frames) -> batch, with the last two static.
        init_probes: (seed, config) -> parameters that serve the objective alone.
        objective: (trained, batch, config, weights, *, compute_dtype, remat) -> loss, metrics.

    Raises:
        CheckpointError: the checkpoint in `out` is of another model, or `init` does not fit the recipe's.
        OutputError: `out` cannot be written.
        VggtjaxError: 50 steps in a row had a loss or gradient that is not finite.
    """
    if textures is None:
        from vggtjax.scenes import load_textures

        textures = load_textures("training")
    run = Run(recipe, Path(out), init_probes(recipe.seed, recipe.model), init, export_dtype)
    where = placement(recipe)
    textures = jax.device_put(textures, where.whole)
    batch_of = jax.jit(make_batch, static_argnums=(2, 3), out_shardings=where.by_clip)
    key = jax.random.key(recipe.data_seed)
    seen: set[tuple[Stage, int]] = set()  # what is compiled, and can be timed
    ahead: deque[Metrics] = deque()
    began = saved = plotted = time.perf_counter()
    mark: tuple[float, int] | None = None  # time and step of the first row: what came before was mostly compiling
    timed = 0

    def report() -> None:
        if progress is not None:
            now, left = time.perf_counter(), None
            if mark is not None and run.step > mark[1]:
                left = (now - mark[0]) / (run.step - mark[1]) * (recipe.total_steps - run.step)
            if stop_after is not None:
                left = min(math.inf if left is None else left, max(began + stop_after - now, 0.0))
            progress(Status(run.step, recipe.total_steps, run.stage, run.seconds, left, run.row))

    report()
    with _signals() as received:
        while run.step < recipe.total_steps:
            index, stage = recipe.stage_at(run.step)
            frames = draw_frames(recipe, run.step)
            step_key = jax.random.fold_in(key, run.step)
            to_time = timed < _TIMED and (stage, frames) in seen
            if to_time:
                jax.block_until_ready(run.state)
            started = time.perf_counter()
            batch = batch_of(step_key, textures, stage, frames)
            if to_time:
                jax.block_until_ready(batch)
            rendered = time.perf_counter()
            metrics, gradient = _loss_and_gradient(run.state.trained, batch, recipe, objective)
            run.state, metrics = _apply_gradient(run.state, gradient, metrics, recipe)
            del batch, gradient
            if to_time:
                jax.block_until_ready(metrics)
                share = (rendered - started) / (time.perf_counter() - started)
                run.averages.add({"render_share": share})
                timed += 1
            seen.add((stage, frames))
            ahead.append(metrics)
            run.advance(index, stage, metrics)
            if len(ahead) > _AHEAD:
                jax.block_until_ready(ahead.popleft())
            if run.step % log_every == 0 or run.step == recipe.total_steps:
                run.log()
                report()
                mark = mark or (time.perf_counter(), run.step)
                timed = 0
            now = time.perf_counter()
            if now - plotted > _PLOT_SECONDS:
                run.plot()
                plotted = time.perf_counter()
            stopping = bool(received) or (stop_after is not None and now - began >= stop_after)
            if stopping or now - saved > checkpoint_seconds:
                run.save()
                saved = time.perf_counter()
            if stopping:
                break
        finished = run.step == recipe.total_steps
        run.save()
        run.plot()
        report()
    if received and not finished:
        if received[0] == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + received[0])
    return Outcome(run.state, finished, run.model_path)


def draw_frames(recipe: Recipe, step: int) -> int:
    """Return the number of frames of a step's clips: one of its stage's, by the data seed and the step."""
    _, stage = recipe.stage_at(step)
    return int(np.random.default_rng((recipe.data_seed, step)).choice(stage.frames))


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list that SIGINT and SIGTERM are put into while the block runs; a second SIGINT interrupts at once."""
    received: list[int] = []

    def note(number: int, _: Any) -> None:
        if number in received and number == signal.SIGINT:
            raise KeyboardInterrupt
        received.append(number)
        logger.info("stopping after this step")

    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield received
        return
    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
