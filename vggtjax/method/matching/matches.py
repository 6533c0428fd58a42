"""Dense matches between frames, from the attention of the pairs of blocks that match (not in the papers).

In some global pairs a patch attends to the patch of another frame that shows the same piece of surface. For every patch
and for frames at a few offsets the match is a soft-argmax of the attention, with a confidence and with the distance
from the patch after going there and back. All are computed inside the layer scan, so no layer's q and k are stored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.network.kernels.frames import Frames
from vggtjax.network.precision import upcast

STEPS = (1, 2, 3, 4, 6, 8)  # offsets between frames that are matched, both ways
_AT_ONCE = 4  # pairs of frames whose attention is in memory
CYCLE = 0.75  # patches; matches that come back further away count little, and are counted as lost
MATCHED_SHARE = 0.25  # of the matches with the next frames that come back, below which nothing is matched
_EPSILON = 1e-12


class Matches(NamedTuple):
    """Matches of every patch with frames at M offsets; x and y in patches, the first patch's centre at (0.5, 0.5)."""

    position: Float[Array, "*B S M P 2"]
    confidence: Float[Array, "*B S M P"]  # attention to the nine patches around the match, in [0, 1]; 0 for no frame
    cycle: Float[Array, "*B S M P"]  # distance in patches between a patch and the match of its match

    @property
    def weight(self) -> Float[Array, "*B S M P"]:
        """How far a match can be trusted, in [0, 1]: confidence x exp(-(cycle / 0.75)^2)."""
        return self.confidence * jnp.exp(-((self.cycle / CYCLE) ** 2))


class FramePairs(NamedTuple):
    """Which frames of a clip are matched with which."""

    offsets: tuple[int, ...]
    others: Int[np.ndarray, "S M"]  # the frame at each offset; the frame itself where there is none
    exist: Bool[np.ndarray, "S M"]


def frame_pairs(S: int, steps: tuple[int, ...] = STEPS) -> FramePairs:
    """Return the pairs of frames that are matched in a clip of S frames; their number grows linearly with S."""
    offsets = tuple(sign * step for step in steps if step < S for sign in (-1, 1))
    frames = np.arange(S)[:, None]
    others = frames + np.array(offsets, int)[None]
    exist = (others >= 0) & (others < S)
    return FramePairs(offsets, np.where(exist, others, frames), exist)


def come_back(matches: Matches, pairs: FramePairs) -> Bool[Array, ""]:
    """Return whether enough of a clip's matches with the next frames come back; else matches say nothing."""
    next_ones = np.abs(pairs.offsets) == min(map(abs, pairs.offsets))
    number = jnp.sum(((matches.cycle < CYCLE) & (matches.confidence > 0))[:, next_ones])
    possible = jnp.sum(pairs.exist[:, next_ones]) * matches.cycle.shape[2]
    return number.astype(jnp.float32) > MATCHED_SHARE * possible.astype(jnp.float32)


def patch_centres(grid: tuple[int, int]) -> Float[np.ndarray, "P 2"]:
    """Return x and y of the centres of patches, in patches."""
    y, x = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    return np.stack([x, y], axis=-1).astype(np.float32) + 0.5


@dataclass(frozen=True)
class DenseMatches:
    """An `Accumulator` of the matches of some pairs of blocks: of each match, that of the pair with the largest weight.

    Attributes:
        layers: indices of the pairs of blocks that match.
        depth: number of pairs of the model.
        grid: rows and columns of patches.
        frames: where the frames are. Frames on other devices are fetched from there.
    """

    layers: tuple[int, ...]
    depth: int
    grid: tuple[int, int]
    frames: Frames = Frames()

    def layer_counts(self) -> Int[np.ndarray, "depth 1"]:
        """Return 1 for the pairs of blocks that are read."""
        return np.isin(np.arange(self.depth), self.layers).astype(int)[:, None]

    def zeros(self, B: int, S: int, P: int) -> Matches:
        """Return matches without confidence."""
        M = len(frame_pairs(self.frames.counted(S)).offsets)
        return Matches(jnp.zeros((B, S, M, P, 2)), jnp.zeros((B, S, M, P)), jnp.zeros((B, S, M, P)))

    def add(
        self,
        sums: Matches,
        counts: Int[Array, " 1"],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None = None,
    ) -> Matches:
        """Return the better match of every patch, of the matches so far and those of this pair of blocks, if read.

        The patches are the last tokens of a frame. Frames from `frame_count` on are not matched.
        """

        def better(sums: Matches, q: Array, k: Array) -> Matches:
            found = self._matched(q, k, frame_count)
            is_better = found.weight >= sums.weight
            return Matches(
                jnp.where(is_better[..., None], found.position, sums.position),
                jnp.where(is_better, found.confidence, sums.confidence),
                jnp.where(is_better, found.cycle, sums.cycle),
            )

        with jax.named_scope("matches"):
            return jax.lax.cond(counts[0] > 0, better, lambda sums, q, k: sums, sums, q, k)

    def _matched(self, q: Array, k: Array, frame_count: Int[Array, " B"] | None) -> Matches:
        B, S, _, N, D = q.shape
        P = self.grid[0] * self.grid[1]
        pairs = self._pairs_here(S)
        reach = max(map(abs, pairs.offsets))
        back = np.array([pairs.offsets.index(-offset) for offset in pairs.offsets])
        exist = jnp.broadcast_to(jnp.asarray(pairs.exist), (B, *pairs.exist.shape))
        if frame_count is not None:
            exist = exist & (jnp.asarray(pairs.others)[None] < frame_count[:, None, None])

        def one_clip(clip: tuple[Array, Array, Array]) -> Matches:
            q, k, exist = clip
            rows, columns = (x[:, -P:].reshape(S, P, N * D) for x in (q, k))
            near, first_near = self.frames.around(columns, reach, axis=0)
            others = jnp.asarray(pairs.others) - first_near
            numbers = jnp.stack([jnp.arange(S)[:, None].repeat(len(back), 1), others], axis=-1).reshape(-1, 2)

            def of_frames(pair):
                row, column = upcast(rows[pair[0]]), upcast(near[pair[1]])
                return _soft_argmax(row @ column.T / (N * D**0.5), self.grid)

            found = jax.lax.map(of_frames, numbers, batch_size=_AT_ONCE)
            position, confidence, best = (x.reshape(S, len(back), *x.shape[1:]) for x in found)
            position_near, first = self.frames.around(position, reach, axis=0)
            of_other = position_near[jnp.asarray(pairs.others) - first, back[None]]  # [S, M, P, 2]
            returned = jnp.take_along_axis(of_other, best[..., None], axis=2)
            squared = jnp.sum((returned - patch_centres(self.grid)[None, None]) ** 2, axis=-1)
            return Matches(position, jnp.where(exist[..., None], confidence, 0), jnp.sqrt(squared + _EPSILON))

        return jax.lax.map(one_clip, (q, k, exist))

    def _pairs_here(self, S: int) -> FramePairs:
        """Return the pairs of the S frames here, with numbers among those of all devices."""
        counted, total = self.frames.counted(S), self.frames.total(S)
        offsets, others, exist = frame_pairs(counted)
        if self.frames.mesh is None:
            return FramePairs(offsets, others, exist)
        padding = ((0, total - counted), (0, 0))
        others = np.concatenate([others, np.arange(counted, total)[:, None].repeat(len(offsets), 1)])
        tables = (jnp.asarray(others), jnp.asarray(np.pad(exist, padding)))
        return FramePairs(offsets, *(self.frames.share(table, S, axis=0) for table in tables))  # pyright: ignore


def _soft_argmax(
    logits: Float[Array, "P J"], grid: tuple[int, int]
) -> tuple[Float[Array, "P 2"], Float[Array, " P"], Int[Array, " P"]]:
    """Return the attention's mean position in the 3 x 3 patches around its maximum, its mass there, and the maximum."""
    best = jnp.argmax(logits, axis=-1)
    window, inside = _windows(grid)
    near = jnp.take_along_axis(logits, jnp.asarray(window)[best], axis=-1)  # [P, 9]
    mass = jnp.where(jnp.asarray(inside)[best], jnp.exp(near - jax.nn.logsumexp(logits, axis=-1, keepdims=True)), 0)
    confidence = mass.sum(axis=-1)
    position = jnp.einsum("pn,pnc->pc", mass, jnp.asarray(patch_centres(grid))[jnp.asarray(window)[best]])
    return position / jnp.maximum(confidence, _EPSILON)[:, None], confidence, best


def _windows(grid: tuple[int, int]) -> tuple[Int[np.ndarray, "P 9"], Bool[np.ndarray, "P 9"]]:
    """Return the nine patches around every patch, and which of them exist."""
    h, w = grid
    steps = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)])
    places = np.stack(np.divmod(np.arange(h * w), w), axis=-1)[:, None] + steps[None]
    inside = np.all((places >= 0) & (places < (h, w)), axis=-1)
    return np.where(inside, places[..., 0] * w + places[..., 1], 0), inside
