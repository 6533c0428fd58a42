"""How a training run logs, saves, ends, and uses the cores of a CPU. Does not import jax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vggtjax.storage.flags import InWords
from vggtjax.storage.json_values import Count, Positive, check_fields


@dataclass(frozen=True)
class RunOptions:
    """How a run logs, saves, ends, and uses the cores of a CPU. Raises InputError for values out of range.

    Attributes:
        log_every: steps that a row of metrics.csv averages over.
        checkpoint_seconds: time between checkpoints.
        seconds: time limit, after which the run ends with a checkpoint; the same command resumes it. None is set
            by default.
        dtype: of the weights in model.safetensors.
        workers: processes that share the clips of a step on a CPU, a divisor of every batch. The numbers are those of
            one process up to rounding. Each takes working memory of its own; on two cores, two are faster than one. A
            script that takes several needs `if __name__ == "__main__":`.
    """

    log_every: Count = 50
    checkpoint_seconds: Positive = 600.0
    seconds: InWords[Positive | None] = None
    dtype: Literal["float32", "bfloat16"] = "float32"
    workers: Count = 1

    def __post_init__(self) -> None:
        check_fields(self)
