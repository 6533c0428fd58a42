"""True matches as a target of global attention: attention learns them long before the heads' losses fall."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.training.truth import MatchCounts, Matches


class MatchSums(NamedTuple):
    """Sums over the supervised layers."""

    loss: Float[Array, ""]
    accuracy: Float[Array, ""]


class MatchLoss:
    """An `Accumulator` of the loss of attention against true matches, in place of motion cues.

    The first half of the heads learns to attend from every patch to its match in the first frame, among the patches of
    all frames; the second half to its match in each other frame, among that frame's patches.
    """

    def __init__(self, matches: Matches, counts: MatchCounts, layers: tuple[int, ...], depth: int) -> None:
        self._matches, self._counts, self._layers, self._depth = matches, counts, layers, depth

    def layer_counts(self) -> Int[np.ndarray, " L"]:
        """Return 1 for supervised layers, else 0."""
        return np.isin(np.arange(self._depth), self._layers).astype(np.int32)

    def zeros(self, B: int, S: int, P: int) -> MatchSums:
        """Return empty sums."""
        return MatchSums(jnp.zeros(()), jnp.zeros(()))

    def add(
        self,
        sums: MatchSums,
        supervised: Int[Array, ""],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None = None,
    ) -> MatchSums:
        """Add the loss of a supervised layer; a branch skips the computation for other layers.

        The patches are the last tokens of a frame. Padded frames have no visible matches.
        """
        P = self._matches.patch.shape[-1]

        @jax.checkpoint  # otherwise the scan stores the logits of every layer
        def layer(sums: MatchSums, q: Array, k: Array) -> MatchSums:
            loss, accuracy = match_loss(self._matches, self._counts, q[:, :, -P:], k[:, :, -P:])
            return MatchSums(sums.loss + loss / len(self._layers), sums.accuracy + accuracy / len(self._layers))

        return jax.lax.cond(supervised > 0, layer, lambda sums, q, k: sums, sums, q, k)


def match_loss(
    matches: Matches, counts: MatchCounts, q: Float[Array, "B S P N D"], k: Float[Array, "B S P N D"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the cross-entropy of attention against true matches, and the share of correctly matched patches.

    Both are means over `counts` of matches.
    """
    B, S, P, N, D = q.shape
    half = N // 2
    logits = jnp.einsum("brpnd,bsjnd->bnrpsj", q, k) / D**0.5
    first = jax.nn.log_softmax(logits[:, :half].reshape(B, half, S, P, S * P), axis=-1)
    to_first = matches.patch[:, :, 0]  # [B, R, P]; frame 0 comes first, so the index is that of the key
    picked = jnp.take_along_axis(first, to_first[:, None, :, :, None], axis=-1)[..., 0].mean(axis=1)  # [B, R, P]
    loss = -_mean(picked, matches.from_others, counts.from_others)

    each = jax.nn.log_softmax(logits[:, half:].mean(axis=1), axis=-1)  # [B, R, P, S, P]
    index = matches.patch.swapaxes(2, 3)  # [B, R, P, S]
    other = matches.between.swapaxes(2, 3)
    picked = jnp.take_along_axis(each, index[..., None], axis=-1)[..., 0]
    correct = jnp.argmax(each, axis=-1) == index
    accuracy = _mean(correct.astype(jnp.float32), other, counts.between)
    return loss - _mean(picked, other, counts.between), accuracy


def _mean(values: Array, weight: Array, count: Array) -> Float[Array, ""]:
    return (values * weight).sum() / jnp.where(count > 0, count, 1)
