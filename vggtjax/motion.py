"""Motion cues from Gram similarities of q and k, and their saliency (4DVGGT-D, stage 1; the cues are VGGT4D's).

A mean map needs no Gram matrix: mean_{s,j} q_i . q_sj = q_i . mean_{s,j} q_sj. A std map needs one P x P product
per frame, of its rows with keys averaged over the source frames. Both are exact, and both are accumulated inside the
layer scan, so that q and k of no layer are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.config import Cue, Gram, MotionConfig

_EPSILON = 1e-6

Sums = tuple[Array, ...]


@dataclass(frozen=True)
class GramCues:
    """The table of cues for a model with `depth` pairs and one similarity. The sums are a tuple, one entry per cue."""

    motion: MotionConfig
    depth: int
    gram: Gram = "cosine"

    def layer_counts(self) -> np.ndarray:
        """Return int [depth, cues]: how often a cue reads a pair; never or once, unless layers were scaled down."""
        return np.array([[self._layers(cue).count(layer) for cue in self.motion.cues] for layer in range(self.depth)])

    def zeros(self, B: int, S: int, P: int) -> Sums:
        """Return empty sums: [B, S, P], or [B, S, P, P] for a std over several layers, which are averaged first."""
        return tuple(jnp.zeros((B, S, P) + (P,) * self._keeps_gram(cue)) for cue in self.motion.cues)

    def add(
        self, sums: Sums, counts: Int[Array, " cues"], q: Float[Array, "B S P N D"], k: Float[Array, "B S P N D"]
    ) -> Sums:
        """Add one pair's q and k (after norm and rotation) to the cues whose layers it belongs to."""
        q, k = (x.astype(jnp.float32) for x in (q, k))
        weights = jnp.asarray(source_weights(q.shape[1], self.motion.offsets))

        def added(cue: Cue):
            def one_frame(rows, columns):
                if cue.statistic == "mean":
                    return _mean_similarity(rows, columns)
                gram = _similarities(rows, columns)
                return gram if self._keeps_gram(cue) else _sample_std(gram)

            def branch(total, count, q, k):
                rows, columns = ({"q": q, "k": k}[name] for name in (cue.rows, cue.columns))
                if self.gram == "cosine":
                    rows, columns = _unit(rows), _unit(columns)
                if cue.statistic == "mean":
                    columns = columns.mean(axis=2)  # [B, S, N, D]
                columns = jnp.einsum("rs,bs...->br...", weights, columns)  # averaged over each frame's sources
                return total + count * jax.vmap(jax.vmap(one_frame))(rows, columns)

            return branch

        return tuple(
            jax.lax.cond(counts[i] > 0, added(cue), lambda total, count, q, k: total, total, counts[i], q, k)
            for i, (cue, total) in enumerate(zip(self.motion.cues, sums, strict=True))
        )

    def maps(self, sums: Sums) -> dict[str, Float[Array, "B S P"]]:
        """Return every cue's map by name, min-max normalised per frame."""
        result = {}
        for cue, total in zip(self.motion.cues, sums, strict=True):
            average = total / len(self._layers(cue))
            result[cue.name] = normalise(_sample_std(average) if self._keeps_gram(cue) else average)
        return result

    def saliency(self, sums: Sums) -> Float[Array, "B S P"]:
        """Return the product of the cues' maps, inverted where the table says so, min-max normalised per frame.

        A single frame has nothing to compare with and gets saliency 0.
        """
        maps = self.maps(sums)
        product = jnp.ones_like(next(iter(maps.values())))
        if product.shape[1] == 1:
            return jnp.zeros_like(product)
        for cue in self.motion.cues:
            product = product * (1 - maps[cue.name] if cue.inverted else maps[cue.name])
        return normalise(product)

    def _layers(self, cue: Cue) -> tuple[int, ...]:
        return self.motion.layers(cue, self.depth)

    def _keeps_gram(self, cue: Cue) -> bool:
        return cue.statistic == "std" and len(set(self._layers(cue))) > 1


def source_weights(S: int, offsets: tuple[int, ...]) -> np.ndarray:
    """Return float32 [S, S]: row r averages the source frames r + offset that exist.

    A frame for which none exists (as in clips of one to three frames) is compared with every other frame.
    """
    weights = np.zeros((S, S), np.float32)
    for r in range(S):
        sources = [r + offset for offset in offsets if 0 <= r + offset < S] or [s for s in range(S) if s != r]
        weights[r, sources] = 1 / max(len(sources), 1)
    return weights


def normalise(values: Float[Array, "B S P"]) -> Float[Array, "B S P"]:
    """Min-max normalise per frame: (m - min) / (max - min + 1e-6)."""
    low, high = values.min(axis=-1, keepdims=True), values.max(axis=-1, keepdims=True)
    return (values - low) / (high - low + _EPSILON)


def _mean_similarity(rows: Float[Array, "P N D"], source_mean: Float[Array, "N D"]) -> Float[Array, " P"]:
    return jnp.einsum("pnd,nd->p", rows, source_mean) / rows.shape[1]


def _similarities(rows: Float[Array, "P N D"], columns: Float[Array, "J N D"]) -> Float[Array, "P J"]:
    return jnp.einsum("pnd,jnd->pj", rows, columns) / rows.shape[1]


def _unit(x: Float[Array, "... D"]) -> Float[Array, "... D"]:
    return x * jax.lax.rsqrt(jnp.maximum(jnp.sum(x * x, axis=-1, keepdims=True), 1e-24))


def _sample_std(x: Float[Array, "... J"]) -> Float[Array, ...]:
    """Unbiased standard deviation over the last axis; 0 where there is a single token."""
    centred = x - x.mean(axis=-1, keepdims=True)
    variance = jnp.sum(centred * centred, axis=-1) / max(x.shape[-1] - 1, 1)
    return jnp.sqrt(jnp.maximum(variance, 1e-30))  # the floor keeps the gradient finite where all agree
