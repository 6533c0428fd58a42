"""Motion cues from Gram similarities of q and k, and their saliency (4DVGGT-D, stage 1; the cues are VGGT4D's).

A mean map needs no Gram matrix: mean_{s,j} q_i . q_sj = q_i . mean_{s,j} q_sj. A std map needs one P x P product
per frame, of its rows with keys averaged over the source frames. Both are exact. Both are accumulated inside the layer
scan, so no layer's q and k are stored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.config import Cue, Gram, MotionConfig
from vggtjax.errors import check_choice
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.kernels.in_place import added_if
from vggtjax.network.precision import products, upcast

FRAMES_AT_ONCE = {"cpu": 4, "default": 16}  # whose similarities are in memory, by platform
_EPSILON = 1e-6

Sums = tuple[Array, ...]


@dataclass(frozen=True)
class GramCues:
    """An `Accumulator` of a table of cues, for a model with `depth` pairs and one similarity; one sum per cue.

    Source frames on other devices are fetched from there, in the pairs that a cue reads. `precision` is that of
    `Compute`.
    """

    motion: MotionConfig
    depth: int
    gram: Gram = "cosine"
    frames: Frames = Frames()
    precision: str = "highest"

    def __post_init__(self) -> None:
        check_choice("gram", self.gram, get_args(Gram))

    def layer_counts(self) -> np.ndarray:
        """Return int [depth, cues]: how often a cue reads a pair; more than once only in models with fewer layers."""
        return np.array([[self._layers(cue).count(layer) for cue in self.motion.cues] for layer in range(self.depth)])

    def zeros(self, B: int, S: int, P: int) -> Sums:
        """Return empty sums: [B, S, P], or [B, S, P, P] for a std over several layers, which are averaged first."""
        return tuple(jnp.zeros((B, S, P) + (P,) * self.keeps_gram(cue)) for cue in self.motion.cues)

    def add(
        self,
        sums: Sums,
        counts: Int[Array, " cues"],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None = None,
    ) -> Sums:
        """Return the sums after adding one pair's q and k (after norm and rotation) to the cues that read this pair.

        The patches are the last tokens of a frame; the tokens before them are excluded. Of clips with a `frame_count`
        only the real frames are sources, and each real frame needs a source at one of the offsets.
        """
        B, S, _, heads, _ = q.shape
        index, weights, reach = self._sources_here(S)
        weights = jnp.broadcast_to(weights, (B, *weights.shape))
        if frame_count is not None:
            weights = jnp.where(index[None] < frame_count[:, None, None], weights, 0)
            weights = weights / jnp.maximum(weights.sum(axis=-1, keepdims=True), _EPSILON)

        def of_pair(cue: Cue):
            def vectors(x: Float[Array, "... T N D"]) -> Float[Array, "... P N D"]:
                patches = upcast(x[..., -sums[0].shape[2] :, :, :])
                return _unit(patches) if self.gram == "cosine" else patches

            def one_clip(
                rows: Float[Array, "S T N D"],
                columns: Float[Array, "S T N D"],
                index: Int[Array, "S m"],
                weights: Float[Array, "S m"],
            ) -> Float[Array, "S ..."]:
                def mean_similarity(frame):
                    row, index, weights = frame
                    source = jnp.einsum("m,mnd->nd", weights, means[index])
                    return jnp.einsum("pnd,nd->p", vectors(row), source) / heads

                def of_gram(frame):
                    row, index, weights = frame
                    source = jnp.einsum("m,mpnd->pnd", weights, vectors(near[index]))
                    gram = jnp.einsum("pnd,jnd->pj", vectors(row), source) / heads
                    return gram if self.keeps_gram(cue) else OF_GRAM[cue.statistic](gram)

                if cue.statistic == "mean":
                    means = _over_frames(lambda column: vectors(column).mean(axis=0), columns)  # [S, N, D]
                    means = self.frames.gather(means, axis=0)
                    return _over_frames(mean_similarity, (rows, index, weights))
                near, first_near = self.frames.around(columns, reach, axis=0)
                return _over_frames(of_gram, (rows, index - first_near, weights))

            def summand(count, index, weights, q, k):
                rows, columns = ({"q": q, "k": k}[name] for name in (cue.rows, cue.columns))
                with products(self.precision):
                    return count.astype(weights.dtype) * jax.vmap(one_clip, (0, 0, None, 0))(
                        rows, columns, index, weights
                    )

            return summand

        totals = []
        for i, (cue, total) in enumerate(zip(self.motion.cues, sums, strict=True)):
            is_read = counts[i] > 0
            if totals:
                is_read = self.frames.after(is_read, totals[-1])
            with jax.named_scope(f"cue-{cue.name}"):
                total = added_if(is_read, total, of_pair(cue), counts[i], jnp.asarray(index), weights, q, k)
            total, (q, k) = self.frames.in_order(total, (q, k))  # in the gradient, the last cue communicates first
            totals.append(total)
        return tuple(totals)

    def maps(self, sums: Sums) -> dict[str, Float[Array, "B S P"]]:
        """Return every cue's map by name, min-max normalised per frame."""
        result = {}
        for cue, total in zip(self.motion.cues, sums, strict=True):
            average = total / len(self._layers(cue))
            result[cue.name] = normalise(OF_GRAM[cue.statistic](average) if self.keeps_gram(cue) else average)
        return result

    def saliency(self, sums: Sums, exponents: Float[Array, " cues"] | None = None) -> Float[Array, "B S P"]:
        """Return the product of the cues' maps, inverted where the table says so, min-max normalised per frame.

        The saliency of a single frame is 0. To every map, inverted or not, the table's floor is added (0 in the
        papers); the sum is raised to the map's exponent (1 in the papers).
        """
        maps = self.maps(sums)
        product = jnp.ones_like(next(iter(maps.values())))
        for i, cue in enumerate(self.motion.cues):
            factor = self.motion.floor + (1 - maps[cue.name] if cue.inverted else maps[cue.name])
            product = product * (factor if exponents is None else _power(factor, exponents[i]))
        return normalise(product)

    def _sources_here(self, S: int) -> tuple[Array | np.ndarray, Array | np.ndarray, int]:
        """Return `sources` of the S frames here, with numbers among those of all devices; and how far they are off."""
        counted, total = self.frames.counted(S), self.frames.total(S)
        index, weights = sources(counted, self.motion.offsets)
        added = total - counted  # they are their own sources, without weight
        index = np.concatenate([index, np.repeat(np.arange(counted, total)[:, None], index.shape[1], axis=1)])
        weights = np.concatenate([weights, np.zeros((added, weights.shape[1]), np.float32)])
        if self.frames.mesh is None:
            return index, weights, 0
        index_here, weights_here = (self.frames.share(jnp.asarray(table), S, axis=0) for table in (index, weights))
        return index_here, weights_here, int(np.abs(index - np.arange(total)[:, None]).max())

    def _layers(self, cue: Cue) -> tuple[int, ...]:
        return self.motion.layers(cue, self.depth)

    def keeps_gram(self, cue: Cue) -> bool:
        """Return whether a cue's Gram maps are averaged over layers before the statistic of each row is taken."""
        return cue.statistic in OF_GRAM and len(set(self._layers(cue))) > 1


def sources(S: int, offsets: tuple[int, ...]) -> tuple[Int[np.ndarray, "S m"], Float[np.ndarray, "S m"]]:
    """Return the source frames of every frame and their weights: the mean over the frames r + offset that exist.

    A frame without such a frame (as in clips of one to three frames) is compared with every other frame. Rows with
    fewer sources than the longest are padded with the frame itself, with weight 0.
    """
    rows = [[r + offset for offset in offsets if 0 <= r + offset < S] for r in range(S)]
    rows = [row or [s for s in range(S) if s != r] for r, row in enumerate(rows)]
    most = max(1, *map(len, rows))
    index = np.array([row + [r] * (most - len(row)) for r, row in enumerate(rows)])
    weights = np.array([[1 / max(len(row), 1)] * len(row) + [0] * (most - len(row)) for row in rows], np.float32)
    return index, weights


def _over_frames(function, frames):
    """Map a function over frames, a few of them vectorised at a time, which bounds the memory."""

    def at_once(count: int):
        return lambda frames: jax.lax.map(function, frames, batch_size=count)

    return jax.lax.platform_dependent(frames, **{name: at_once(count) for name, count in FRAMES_AT_ONCE.items()})


def normalise(values: Float[Array, "B S P"]) -> Float[Array, "B S P"]:
    """Min-max normalise per frame: (m - min) / (max - min + 1e-6)."""
    low, high = values.min(axis=-1, keepdims=True), values.max(axis=-1, keepdims=True)
    return (values - low) / (high - low + _EPSILON)


def _unit(x: Float[Array, "... D"]) -> Float[Array, "... D"]:
    return x * jax.lax.rsqrt(jnp.maximum(jnp.sum(x * x, axis=-1, keepdims=True), 1e-24))


def _power(x: Float[Array, "B S P"], exponent: Float[Array, ""]) -> Float[Array, "B S P"]:
    """Return x ** exponent for x in [0, 2]; close to 0, where the slope is unbounded, x."""
    return jnp.where(x > _EPSILON, jnp.maximum(x, _EPSILON) ** exponent, x)


def _sample_std(x: Float[Array, "... J"]) -> Float[Array, ...]:
    """Unbiased standard deviation over the last axis; 0 for a single token."""
    centred = x - x.mean(axis=-1, keepdims=True)
    variance = jnp.sum(centred * centred, axis=-1) / max(x.shape[-1] - 1, 1)
    return jnp.sqrt(jnp.maximum(variance, 1e-30))  # the floor keeps the gradient finite where all values are equal


OF_GRAM = {"std": _sample_std}  # statistics of the rows of a Gram map; "mean" needs no Gram map
