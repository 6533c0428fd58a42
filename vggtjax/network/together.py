"""Several accumulators as one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.network.aggregator import Accumulator


@dataclass(frozen=True)
class Together:
    """An `Accumulator` of several, whose sums are the tuple of theirs."""

    parts: tuple[Accumulator, ...]

    def layer_counts(self) -> Int[np.ndarray, "depth parts"]:
        """Return the counts of all parts, side by side."""
        return np.concatenate(self._counts(), axis=1)

    def zeros(self, B: int, S: int, P: int) -> tuple[Any, ...]:
        """Return empty sums of every part."""
        return tuple(part.zeros(B, S, P) for part in self.parts)

    def add(
        self,
        sums: tuple[Any, ...],
        counts: Int[Array, " parts"],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None = None,
    ) -> tuple[Any, ...]:
        """Return the sums of every part with one pair of blocks added."""
        ends = np.cumsum([part.shape[1] for part in self._counts()])[:-1]
        own = jnp.split(counts, ends)
        return tuple(
            part.add(total, count, q, k, frame_count) for part, total, count in zip(self.parts, sums, own, strict=True)
        )

    def _counts(self) -> list[np.ndarray]:
        counts = [np.asarray(part.layer_counts()) for part in self.parts]
        return [count.reshape(len(count), -1) for count in counts]
