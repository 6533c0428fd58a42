"""How a training run logs, saves and ends. Does not import jax."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vggtjax.storage.json_values import Count, Positive, check_fields


@dataclass(frozen=True)
class RunOptions:
    """How a run logs, saves and ends. Raises InputError for values out of range.

    Attributes:
        log_every: steps that a row of metrics.csv averages over.
        checkpoint_seconds: time between checkpoints.
        seconds: time limit, after which the run ends with a checkpoint; the same command resumes it. None is set
            by default.
        clips: folder for rendered clips of worlds; runs can share it, and clips of equal settings, assets, sizes and
            data_seed are rendered once. By default clips/ in --out.
        renderers: processes that render clips of worlds.
        dtype: of the weights in model.safetensors.
    """

    log_every: Count = 50
    checkpoint_seconds: Positive = 600.0
    seconds: Positive | None = None
    clips: Path | None = None
    renderers: Count = 1
    dtype: Literal["float32", "bfloat16"] = "float32"

    def __post_init__(self) -> None:
        check_fields(self)
