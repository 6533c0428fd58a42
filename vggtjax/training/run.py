"""The bookkeeping of a training run: its devices, state, averages, checkpoints, tables and exported model."""

from __future__ import annotations

import json
import logging
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vggtjax.errors import CheckpointError, VggtjaxError
from vggtjax.network.checkpoint import Model, numpy_dtype, save_model
from vggtjax.network.layers import Params
from vggtjax.network.model import HEADS
from vggtjax.storage.json_values import Natural, NotNegative, parse_json
from vggtjax.storage.writing import writing
from vggtjax.training import checkpoints
from vggtjax.training.metrics import Averages, Row, plot, read_metrics, write_metrics
from vggtjax.training.options import RunOptions
from vggtjax.training.recipe import Phase, Recipe
from vggtjax.training.state import Metrics, exported, initial_state, state_shapes

MOST_SKIPPED = 50  # steps in a row that may be skipped
_PLOT_SECONDS = 180.0

logger = logging.getLogger(__name__)


class Placement(NamedTuple):
    """Shardings of replicated arrays, and of arrays with the batch as first axis."""

    whole: NamedSharding
    by_clip: NamedSharding


def placement(recipe: Recipe) -> Placement:
    """Return shardings over the largest number of this machine's devices that divides the batch of every phase.

    A CPU counts as one device unless XLA_FLAGS=--xla_force_host_platform_device_count=N splits it, which keeps more of
    its cores busy with small models.
    """
    devices = jax.local_devices()
    batches = math.gcd(*(phase.batch for phase in recipe.stages))
    count = max(n for n in range(1, len(devices) + 1) if batches % n == 0)
    mesh = Mesh(np.array(devices[:count]), ("clips",))
    return Placement(NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("clips")))


@dataclass(frozen=True)
class Labels:
    """What the file of a run's model says of it beside its name: `note` and `untrained_heads` of `Model`."""

    note: str = ""
    untrained_heads: tuple[str, ...] = ()


@dataclass(frozen=True)
class Notes:
    """The counts of a run, as a checkpoint keeps them beside its state."""

    averages: Averages
    samples: Natural
    skipped_in_a_row: Natural
    seconds: NotNegative
    labels: Labels


def labels_of(recipe: Recipe, init: Model | Params | None, note: str) -> Labels:
    """Return note (`note` for random parameters, else that of `init`) and untrained heads of the model of a run.

    Untrained heads were untrained at the start, and the run leaves them unchanged. Parameters alone have no labels.
    """
    if init is not None and not isinstance(init, Model):
        return Labels()
    note, untrained = (note, recipe.model.heads) if init is None else (init.note, init.untrained_heads)
    return Labels(note, tuple(head for head in untrained if HEADS[head] in recipe.frozen))


class Run:
    """The state and the counts of a run, and the files in its folder."""

    def __init__(
        self,
        recipe: Recipe,
        out: Path,
        probes: Params,
        init: Params | None,
        labels: Labels,
        options: RunOptions,
    ) -> None:
        """Resume from the newest checkpoint in `out`, or start with `probes` and `init` (None: random parameters)."""
        self.recipe, self.out, self.options, self.labels = recipe, out, options, labels
        self.checkpoints, self.model_path = out / "checkpoints", out / "model.safetensors"
        self.step, self.phase, self.samples, self.skipped_in_a_row = 0, 0, 0, 0
        self.averages = Averages()
        self.pending: list[Metrics] = []  # of the last steps, on the device
        self.row: Row = {}
        self.exported: int | None = None  # step whose model this run has written
        self.earlier = 0.0  # seconds of the runs before this one
        if checkpoints.latest(self.checkpoints) is None:
            # Committed to the device like a restored state, for which jit would compile again otherwise.
            self.state = jax.device_put(initial_state(recipe, probes, init), placement(recipe).whole)
        else:
            self._restore(probes)
        with writing(out / "recipe.json") as temporary:
            temporary.write_text(recipe.to_json(), "utf-8")
        self.table = out / "metrics.csv"
        earlier = read_metrics(self.table) if self.table.exists() else []
        self.rows = [row for row in earlier if row["step"] <= self.step]  # a resumed run repeats the later ones
        write_metrics(self.table, self.rows)
        self.began = self._saved_at = self._plotted_at = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time spent training, all runs together."""
        return self.earlier + time.perf_counter() - self.began

    def advance(self, index: int, phase: Phase, metrics: Metrics) -> None:
        """Count a step."""
        self.phase, self.step, self.samples = index, self.step + 1, self.samples + phase.batch
        self.pending.append(metrics)
        if len(self.pending) >= MOST_SKIPPED:
            self.collect()

    def collect(self) -> None:
        """Bring the metrics of the last steps to the host; raise if too many in a row were skipped."""
        for metrics in jax.device_get(self.pending):
            values = {name: float(value) for name, value in metrics.items()}
            skipped = values["skipped"] > 0
            self.averages.add(values, finite_only=skipped)
            self.skipped_in_a_row = self.skipped_in_a_row + 1 if skipped else 0
            if self.skipped_in_a_row >= MOST_SKIPPED:
                raise VggtjaxError(
                    f"{MOST_SKIPPED} steps in a row up to step {self.step} had a loss or gradient that is not finite; "
                    "lower optimiser.learning_rate or optimiser.clip_norm, and start from an earlier checkpoint"
                )
        self.pending.clear()

    def log(self) -> None:
        """Write a row of metrics."""
        self.collect()
        place = {"step": self.step, "stage": self.phase, "seconds": round(self.seconds, 3), "samples": self.samples}
        self.row = {**place, **self.averages.take()}
        self.rows.append(self.row)
        write_metrics(self.table, self.rows)

    def keep(self, *, save: bool) -> None:
        """Draw the metrics, and write a checkpoint and the model, where these are due (`save`: now)."""
        if time.perf_counter() - self._plotted_at > _PLOT_SECONDS:
            self.plot()
        if save or time.perf_counter() - self._saved_at > self.options.checkpoint_seconds:
            self.save()

    def save(self) -> None:
        """Write a checkpoint of this step, unless it exists, and the averaged model."""
        if self.exported == self.step:
            return
        self.collect()
        notes = Notes(self.averages, self.samples, self.skipped_in_a_row, self.seconds, self.labels)
        checkpoints.save(self.checkpoints, self.state, self.recipe, asdict(notes))
        averaged, dtype = exported(self.state, self.recipe), numpy_dtype(self.options.dtype)
        params = jax.tree.map(lambda leaf: np.asarray(leaf).astype(dtype, copy=False), averaged)
        save_model(self.model_path, params, self.recipe.model, name=self.recipe.name, **asdict(self.labels))
        self.exported, self._saved_at = self.step, time.perf_counter()
        logger.info("step %d of %d saved in %s", self.step, self.recipe.total_steps, self.out)

    def plot(self) -> None:
        """Draw the metrics."""
        plot(self.rows, self.out / "metrics.png")
        self._plotted_at = time.perf_counter()

    def _restore(self, probes: Params) -> None:
        restored = checkpoints.restore(self.checkpoints, state_shapes(self.recipe, probes), self.recipe)
        if restored.recipe != self.recipe:
            logger.warning("the recipe differs from that of the checkpoint; resuming with the new recipe")
        self.state = jax.device_put(restored.state, placement(self.recipe).whole)
        self.step = int(restored.state.step)
        what = f"the counts of the run at step {self.step} in {self.checkpoints}"
        notes = parse_json(json.dumps(restored.notes), Notes, what, error=CheckpointError)
        self.averages, self.labels = notes.averages, notes.labels
        self.samples, self.skipped_in_a_row, self.earlier = notes.samples, notes.skipped_in_a_row, notes.seconds
        logger.info("resuming from step %d of %d in %s", self.step, self.recipe.total_steps, self.out)
