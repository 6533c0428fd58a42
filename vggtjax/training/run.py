"""What a training run has counted and written so far: its state, averages, checkpoints and tables."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np

from vggtjax.checkpoint import DType, numpy_dtype, save_model
from vggtjax.errors import CheckpointError, VggtjaxError
from vggtjax.network.layers import Params
from vggtjax.storage.writing import writing
from vggtjax.training import checkpoints
from vggtjax.training.devices import placement
from vggtjax.training.metrics import Averages, MetricsFile, Row, plot
from vggtjax.training.recipe import Recipe, Stage
from vggtjax.training.state import Metrics, exported, initial_state, state_shapes

MOST_SKIPPED = 50  # steps in a row that may be skipped

logger = logging.getLogger(__name__)


class Run:
    """What a run has written and counted so far."""

    def __init__(
        self, recipe: Recipe, out: Path, probes: Params, init: Params | None = None, export_dtype: DType = "float32"
    ) -> None:
        """Take up the newest checkpoint in `out`, or begin with `init` (None for random parameters) and `probes`."""
        self.recipe, self.out, self.export_dtype = recipe, out, numpy_dtype(export_dtype)
        self.checkpoints, self.model_path = out / "checkpoints", out / "model.safetensors"
        self.step, self.stage, self.samples, self.skipped_in_a_row = 0, 0, 0, 0
        self.averages = Averages()
        self.pending: list[Metrics] = []  # of the last steps, on the device
        self.row: Row = {}
        self.saved: int | None = None  # step of the newest checkpoint
        self.earlier = 0.0  # seconds of the runs before this one
        if checkpoints.latest(self.checkpoints) is None:
            # Committed to the device like a restored state, for which jit would compile again otherwise.
            self.state = jax.device_put(initial_state(recipe, probes, init), placement(recipe).whole)
        else:
            self._restore(probes)
        with writing(out / "recipe.json") as temporary:
            temporary.write_text(recipe.to_json(), "utf-8")
        self.table = MetricsFile(out / "metrics.csv", last_step=self.step)
        self.began = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time spent training, all runs together."""
        return self.earlier + time.perf_counter() - self.began

    def advance(self, index: int, stage: Stage, metrics: Metrics) -> None:
        """Count a step."""
        self.stage, self.step, self.samples = index, self.step + 1, self.samples + stage.batch
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
        place = {"step": self.step, "stage": self.stage, "seconds": round(self.seconds, 3), "samples": self.samples}
        self.row = {**place, **self.averages.take()}
        self.table.append(self.row)

    def save(self) -> None:
        """Write a checkpoint of this step and the averaged model, if there are none yet."""
        if self.saved == self.step and self.model_path.exists():
            return
        self.collect()
        notes = {
            "averages": asdict(self.averages),
            "samples": self.samples,
            "skipped_in_a_row": self.skipped_in_a_row,
            "seconds": self.seconds,
        }
        checkpoints.save(self.checkpoints, self.state, self.recipe, notes)
        averaged = exported(self.state, self.recipe)
        params = jax.tree.map(lambda leaf: np.asarray(leaf).astype(self.export_dtype, copy=False), averaged)
        save_model(self.model_path, params, self.recipe.model, name=self.recipe.name)
        self.saved = self.step
        logger.info("step %d of %d saved in %s", self.step, self.recipe.total_steps, self.out)

    def plot(self) -> None:
        """Draw the metrics."""
        plot(self.table.path, self.out / "metrics.png")

    def _restore(self, probes: Params) -> None:
        found = checkpoints.restore(self.checkpoints, state_shapes(self.recipe, probes), self.recipe)
        if found.recipe != self.recipe:
            logger.warning("the recipe is not the one that the checkpoint was written under; going on with the new one")
        self.state = jax.device_put(found.state, placement(self.recipe).whole)
        self.step = self.saved = int(found.state.step)
        try:
            self.averages = Averages(**found.notes["averages"])
            self.samples, self.skipped_in_a_row = int(found.notes["samples"]), int(found.notes["skipped_in_a_row"])
            self.earlier = float(found.notes["seconds"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"the checkpoint of step {self.step} in {self.checkpoints} lacks the counts of a training run ({error})"
            ) from None
        logger.info("going on from step %d of %d in %s", self.step, self.recipe.total_steps, self.out)
