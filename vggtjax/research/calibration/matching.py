"""The pairs of blocks whose attention matches frames, chosen without truth: their matches come back."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.method.matching.matches import CYCLE, MATCHED_SHARE, DenseMatches, frame_pairs

_STEP = 2  # frames between which matches are compared; nearer ones come back in every pair
_OF_BEST = 0.75


@dataclass(frozen=True)
class CameBack:
    """An `Accumulator` of the share of matches, 2 frames apart, that come back within 3/4 of a patch in every pair."""

    depth: int
    grid: tuple[int, int]

    def layer_counts(self) -> Int[np.ndarray, "depth depth"]:
        """Return which pair is read."""
        return np.eye(self.depth, dtype=int)

    def zeros(self, B: int, S: int, P: int) -> Float[Array, "depth B"]:
        """Return shares of 0."""
        return jnp.zeros((self.depth, B))

    def add(
        self,
        sums: Float[Array, "depth B"],
        counts: Int[Array, " depth"],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None = None,
    ) -> Float[Array, "depth B"]:
        """Return the shares with that of one pair; without padding, `frame_count` is None."""
        B, S, P = len(q), q.shape[1], self.grid[0] * self.grid[1]
        of_pair = DenseMatches((0,), 1, self.grid)
        found = of_pair.add(of_pair.zeros(B, S, P), jnp.ones(1, int), q, k, frame_count)
        pairs = frame_pairs(S)
        compared = pairs.exist & (np.abs(pairs.offsets) == min(_STEP, S - 1))
        comes_back = ((found.cycle < CYCLE) & (found.confidence > 0)).sum(axis=-1)
        share = jnp.where(compared[None], comes_back, 0).sum(axis=(1, 2)) / (compared.sum() * P)
        return sums + counts[:, None].astype(sums.dtype) * share[None]


def matching_pairs(shares: Float[np.ndarray, "L N"]) -> tuple[int, ...] | None:
    """Return the pairs that match: those with at least 3/4 of the best pair's share, on average over clips.

    None if even in the best pair fewer than a quarter of the matches come back.
    """
    means = shares.mean(axis=1)
    if means.max() < MATCHED_SHARE:
        return None
    return tuple(int(pair) for pair in np.flatnonzero(means >= _OF_BEST * means.max()))
