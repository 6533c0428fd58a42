"""Several accumulators as one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.network.aggregator import Accumulator
from vggtjax.network.kernels.frames import Frames


@dataclass(frozen=True)
class Accumulators:
    """An `Accumulator` of several, whose sums are the tuple of theirs. Where devices share the frames, one by one."""

    parts: tuple[Accumulator, ...]
    frames: Frames = Frames()

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
        totals = []
        for part, total, count in zip(self.parts, sums, jnp.split(counts, ends), strict=True):
            count_after = self.frames.after(count, totals[-1]) if totals else count
            added = part.add(total, count_after, q, k, frame_count)
            first, *others = jax.tree.leaves(added)
            first, (q, k) = self.frames.in_order(first, (q, k))  # in the gradient, the last part communicates first
            totals.append(jax.tree.unflatten(jax.tree.structure(added), [first, *others]))
        return tuple(totals)

    def _counts(self) -> list[np.ndarray]:
        counts = [np.asarray(part.layer_counts()) for part in self.parts]
        return [count.reshape(len(count), -1) for count in counts]
