"""The training loop: batches, steps, metrics, checkpoints. An interrupted run resumes at its newest checkpoint."""

from __future__ import annotations

import dataclasses
import logging
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax

from vggtjax.network.checkpoint import Model
from vggtjax.network.layers import Params
from vggtjax.storage.writing import locked_folder
from vggtjax.training.data import make_batch as make_scene_batch
from vggtjax.training.data import make_world_batch
from vggtjax.training.draws import Worlds, draw_shape, draws_cameras, opened_worlds
from vggtjax.training.metrics import Row
from vggtjax.training.objective import init_probes as init_scene_probes
from vggtjax.training.objective import objective as scene_objective
from vggtjax.training.options import RunOptions
from vggtjax.training.recipe import Phase, Recipe
from vggtjax.training.run import Run, labels_of, placement
from vggtjax.training.scenes.textures import load_textures
from vggtjax.training.start import adapted
from vggtjax.training.state import Metrics, Objective, TrainingState, apply_gradient, loss_and_gradient

GENERATED_NOTE = "model trained on generated scenes alone"
_AHEAD = 2  # steps that the host may prepare while the device computes
_TIMED = 2  # steps of each interval in which rendering is timed separately

# Two programs: the optimiser, whose shapes never change, is compiled once, not for every size of batch.
_loss_and_gradient = jax.jit(loss_and_gradient, static_argnums=(2, 3))
_apply_gradient = jax.jit(apply_gradient, static_argnums=3, donate_argnums=0)

logger = logging.getLogger(__name__)


class Status(NamedTuple):
    """The progress of a run, at its start, after every row of metrics and at its end."""

    step: int
    total_steps: int
    phase: int
    seconds: float  # spent training, all runs together
    seconds_left: float | None  # at the pace of this run, or until its time is over; None while unknown
    metrics: Row  # the last row


class RunOutcome(NamedTuple):
    """The result of a run: its state, whether all steps are done, and the exported model."""

    state: TrainingState
    finished: bool
    model: Path


@dataclass(frozen=True)
class Task:
    """The data and the loss of a run; by default generated scenes and VGGT's losses.

    Attributes:
        textures: second argument of `make_batch`; None for the textures of the training split.
        make_batch: (key, textures, phase, frames, patch size) -> batch, with the last three static.
        init_probes: (seed, config) -> parameters of the objective alone.
        objective: (trained, batch, config, weights, *, compute_dtype, remat) -> loss, metrics.
        make_world_batch: (key, clips of a pool, phase, frames) -> batch, for steps with worlds; the last two static.
    """

    textures: Any = None
    make_batch: Callable[..., Any] = make_scene_batch
    init_probes: Callable[..., Params] = init_scene_probes
    objective: Objective = scene_objective
    make_world_batch: Callable[..., Any] = make_world_batch


def train(
    recipe: Recipe,
    out: str | Path,
    *,
    init: Model | Params | None = None,
    options: RunOptions | None = None,
    progress: Callable[[Status], object] | None = None,
    task: Task | None = None,
) -> RunOutcome:
    """Train a model, or resume from the newest checkpoint in `out`.

    The batch of a step depends on the recipe and the step alone, so a resumed run gives the numbers of an uninterrupted
    one (on a GPU if its sums have a fixed order: XLA_FLAGS=--xla_gpu_deterministic_ops=true).
    SIGINT and SIGTERM end the run after the current step, with a checkpoint; a second SIGINT ends it at once.

    Args:
        recipe: the model, the data, the losses and the optimiser.
        out: folder for recipe.json, metrics.csv, metrics.png, checkpoints/ and model.safetensors with the averaged
            parameters.
        init: a model to start from, or its parameters; None for random ones. Image size, cues and number of masked
            pairs of the recipe replace those of a model, and its new pairs are added; parameters must have them. A
            model must fit the recipe also when there is a checkpoint, from which the run then resumes.
        options: intervals of metrics and checkpoints, time limit, type of the exported weights.
        progress: called with a Status.
        task: the data and the loss.

    Raises:
        InputError: the recipe has new pairs and `init` is None.
        CheckpointError: the checkpoint in `out` is of another model, or `init` does not fit the recipe's.
        OutputError: `out` cannot be written, or another run is writing into it.
        VggtjaxError: 50 steps in a row had a loss or gradient that is not finite.
    """
    labels = labels_of(recipe, init, GENERATED_NOTE if task is None else "")
    params = adapted(init, recipe) if isinstance(init, Model) else init
    options, task = options or RunOptions(), task or Task()
    clips = options.clips or Path(out) / "clips"
    with locked_folder(out, "checkpoints and a model"), opened_worlds(recipe, clips, options.renderers) as worlds:
        run = Run(recipe, Path(out), task.init_probes(recipe.seed, recipe.model), params, labels, options)
        pace = _Pace(run, progress)
        pace.report()
        with _signals() as received:
            trainer = _Trainer(run, task, worlds)
            while run.step < recipe.total_steps:
                trainer.step()
                if run.step % options.log_every == 0 or run.step == recipe.total_steps:
                    run.log()
                    pace.report()
                    trainer.timed = 0
                stopping = bool(received) or pace.seconds_left <= 0
                run.keep(save=stopping)
                if stopping:
                    break
            finished = run.step == recipe.total_steps
            run.save()
            run.plot()
            pace.report()
    if received and not finished:
        if received[0] == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + received[0])
    return RunOutcome(run.state, finished, run.model_path)


class _Trainer:
    """The compiled parts of a step; in the first steps of each interval, rendering is timed."""

    def __init__(self, run: Run, task: Task, worlds: Worlds | None) -> None:
        where = placement(run.recipe)
        textures = load_textures("training") if task.textures is None else task.textures
        self._run, self._objective = run, task.objective
        self._textures = jax.device_put(textures, where.whole)
        self._make_batch = jax.jit(task.make_batch, static_argnums=(2, 3, 4), out_shardings=where.by_clip)
        self._make_world_batch = jax.jit(task.make_world_batch, static_argnums=(2, 3), out_shardings=where.by_clip)
        self._worlds = worlds
        self._key = jax.random.key(run.recipe.data_seed)
        self._compiled: set[tuple[Phase, int, bool]] = set()
        self._ahead: deque[Metrics] = deque()
        self.timed = 0  # steps timed since the last row of metrics

    def step(self) -> None:
        """Do one step of the run."""
        run, recipe = self._run, self._run.recipe
        index, phase, frames = draw_shape(recipe, run.step)
        knows_cameras = draws_cameras(recipe, run.step)
        program = phase, frames, knows_cameras
        is_timed = self.timed < _TIMED and program in self._compiled
        wait = jax.block_until_ready if is_timed else lambda tree: tree
        wait(run.state)
        began = time.perf_counter()
        key = jax.random.fold_in(self._key, run.step)
        clips = self._worlds.clips(run.step) if self._worlds else None
        if clips is None:
            batch = self._make_batch(key, self._textures, phase, frames, recipe.model.patch_size)
        else:
            batch = self._make_world_batch(key, clips, phase, frames)
        if knows_cameras:
            batch = dataclasses.replace(batch, known_cameras=True)
        wait(batch)
        rendered = time.perf_counter()
        metrics, gradient = _loss_and_gradient(run.state.trained, batch, recipe, self._objective)
        run.state, metrics = wait(_apply_gradient(run.state, gradient, metrics, recipe))
        if is_timed:
            run.averages.add({"render_share": (rendered - began) / (time.perf_counter() - began)})
            self.timed += 1
        self._compiled.add(program)
        run.advance(index, phase, metrics)
        self._ahead.append(metrics)
        if len(self._ahead) > _AHEAD:
            jax.block_until_ready(self._ahead.popleft())


class _Pace:
    """The time that a run has taken and has left, for its progress callback and its time limit."""

    def __init__(self, run: Run, progress: Callable[[Status], object] | None) -> None:
        self._run, self._progress, self._began = run, progress, time.perf_counter()
        self._first: tuple[float, int] | None = None  # time and step of the first row: before it, most is compilation

    @property
    def seconds_left(self) -> float:
        """Seconds until the time limit; infinite without one."""
        limit = self._run.options.seconds
        return math.inf if limit is None else self._began + limit - time.perf_counter()

    def report(self) -> None:
        """Call the progress callback."""
        run, total, left = self._run, self._run.recipe.total_steps, math.inf
        now = time.perf_counter()
        if self._first is not None and run.step > self._first[1]:
            left = (now - self._first[0]) / (run.step - self._first[1]) * (total - run.step)
        if self._first is None and run.row:
            self._first = now, run.step
        left = min(left, max(self.seconds_left, 0.0))
        if self._progress is not None:
            known = left if math.isfinite(left) else None
            self._progress(Status(run.step, total, run.phase, run.seconds, known, run.row))


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list of the SIGINT and SIGTERM received while the block runs; a second SIGINT interrupts at once."""
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
