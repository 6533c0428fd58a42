"""The batch of a step: clips with their truth, and the keys that the network suppresses in them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.config import Suppress, VGGTConfig
from vggtjax.network.suppression import Suppression
from vggtjax.training.scenes.render import SyntheticClip


@partial(jax.tree_util.register_dataclass, data_fields=("clips", "regions", "pairs"), meta_fields=("suppress",))
@dataclass(frozen=True)
class Batch:
    """The clips of a step, and the random regions in which their keys are suppressed: a pytree.

    Attributes:
        clips: the clips and their truth.
        regions: pixels of suppressed patches; None for no suppression in any clip.
        pairs: share of the pairs of blocks, from the first, that suppress keys, in (0, 1]; the same for all clips.
        suppress: how keys are suppressed; static under jit.
    """

    clips: SyntheticClip
    regions: Bool[Array, "B S H W"] | None = None
    pairs: Float[Array, " B"] | None = None
    suppress: Suppress = "zero"

    def suppression(self, config: VGGTConfig) -> Suppression:
        """Return the suppression of the network's keys: a patch is suppressed if its middle pixel is."""
        if self.regions is None or self.pairs is None:
            return Suppression()
        middle = slice(config.patch_size // 2, None, config.patch_size)
        pairs = jnp.ceil(self.pairs[0] * config.depth).astype(jnp.int32)
        return Suppression(self.regions[:, :, middle, middle], self.suppress, pairs)
