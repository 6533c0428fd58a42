"""What a pass gathers of motion: sums of Gram cues, and matches if requested."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.config import Gram, MotionConfig, Witness
from vggtjax.method.cues import GramCues
from vggtjax.method.matching.matches import DenseMatches, Matches
from vggtjax.network.aggregator import Accumulator
from vggtjax.network.kernels.accumulators import Accumulators
from vggtjax.network.kernels.frames import Frames


class Evidence(NamedTuple):
    """What the first pass sees of motion."""

    saliency: Float[Array, "B S h w"]  # of the Gram similarities
    matches: Matches | None = None  # None where none were asked for, and for a single frame


@dataclass(frozen=True)
class Witnesses:
    """The cues of a model's motion table for frames of `grid` patches, and matches with the witness "matches"."""

    motion: MotionConfig
    depth: int  # pairs of the model
    grid: tuple[int, int]
    gram: Gram = "cosine"
    witness: Witness = "gram"
    frames: Frames = Frames()
    precision: str = "highest"

    @property
    def accumulator(self) -> Accumulator:
        """What a pass sums up."""
        if self.witness == "gram":
            return self._cues
        matches = DenseMatches(self.motion.matching_layers(self.depth), self.depth, self.grid, self.frames)
        return Accumulators((self._cues, matches), self.frames)

    def seen(self, sums: Any, B: int, S: int, exponents: Float[Array, " cues"] | None = None) -> Evidence:
        """Return what the sums of a pass show; a saliency of 0 where nothing was summed up, as of a single frame."""
        if sums is None:
            return Evidence(jnp.zeros((B, S, *self.grid)))
        of_cues, matches = (sums, None) if self.witness == "gram" else sums
        return Evidence(self._cues.saliency(of_cues, exponents).reshape(B, S, *self.grid), matches)

    @property
    def _cues(self) -> GramCues:
        return GramCues(self.motion, self.depth, self.gram, self.frames, self.precision)
