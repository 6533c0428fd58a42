"""Token merging in global attention (FastVGGT, arXiv 2509.02560): an approximation, the faster the more frames.

Similar tokens form a group before attention and get the group's output after it. Queries, keys and values are merged
after norm and rotation, so the motion cues read them unmerged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.network.attention import attention
from vggtjax.network.precision import upcast
from vggtjax.network.suppression import Attend, SuppressedKeys, suppressed_attention

IS_ZEROED = {"zero": True, "drop": False}  # whether suppressed keys stay in the softmax, as keys 0
REGION = 2  # patches a side: later frames keep one patch of each such square
STRIDE = 10  # every tenth token is kept as well
_ROWS_AT_ONCE = 800  # tokens whose similarities to all kept tokens are in memory
_BIAS_CHANNELS = 8  # lengths of heads stay multiples of 8, which the kernels of GPUs need


def merged_attention(
    S: int, grid: tuple[int, int], special_tokens: int, *, region: int = REGION, stride: int | None = STRIDE
) -> Attend:
    """Return attention over S frames in place of `suppressed_attention`; of a single frame nothing is merged.

    The first frame, the special tokens, one patch of every square and every `stride`-th token are kept; every other
    token joins the kept token with the most similar key (cosine over all heads). A group has one query, key and value:
    the means over its real tokens. Its key counts as often in the softmax as it has tokens.

    Suppressed keys never enter a mean. "zero": each of them has logit 0, so together they are one key 0 with the mean
    of their values, which is exact. "drop": they are left out. Shares scale keys before these are merged.

    Args:
        S: number of frames.
        grid: rows and columns of patches of a frame, h and w.
        special_tokens: tokens before a frame's patches.
        region: patches a side of the squares; 1 keeps every token, and equals exact attention.
        stride: of the tokens that are kept beside those of the squares; None for no more.
    """
    if S == 1:
        return suppressed_attention
    kept = kept_tokens(S, grid, special_tokens, region, stride)

    def attend(
        q: Float[Array, "B T N D"],
        k: Float[Array, "B T N D"],
        v: Float[Array, "B T N D"],
        suppressed: SuppressedKeys | None,
        is_real: Bool[Array, "B T"] | None = None,
    ) -> Float[Array, "B T N D"]:
        B, T, N, D = q.shape
        real = jnp.ones((B, T), bool) if is_real is None else is_real
        hidden = jnp.zeros((B, T), bool)
        is_zeroed = False
        if suppressed is not None and suppressed.are_shares:
            k = suppressed.scaled(k)
        elif suppressed is not None:
            hidden = suppressed.hidden & suppressed.active
            is_zeroed = IS_ZEROED[suppressed.suppress]

        def one_clip(q, k, v, real, hidden) -> _Merged:
            groups = _groups(k.reshape(T, N * D), kept, real)
            keys = _GroupMeans(kept, groups, real & ~hidden)
            merged_k, merged_v, counts = keys.of(k), keys.of(v), keys.counts
            if is_zeroed:
                zeroed = real & hidden
                count = zeroed.sum(dtype=jnp.float32)
                mean = jnp.tensordot(zeroed.astype(v.dtype), v, 1) / jnp.maximum(count, 1).astype(v.dtype)
                merged_k = jnp.concatenate([merged_k, jnp.zeros_like(mean)[None]])
                merged_v = jnp.concatenate([merged_v, mean[None]])
                counts = jnp.append(counts, count)
            return _Merged(_GroupMeans(kept, groups, real).of(q), merged_k, merged_v, counts, groups)

        merged = jax.vmap(one_clip)(q, k, v, real, hidden)
        out = _counted_attention(merged.q, merged.k, merged.v, merged.counts)
        return jax.vmap(lambda out, groups: out[groups])(out, merged.groups)

    return attend


def kept_tokens(
    S: int, grid: tuple[int, int], special_tokens: int, region: int = REGION, stride: int | None = STRIDE
) -> Int[np.ndarray, " K"]:
    """Return the tokens that others are merged into, in rising order; those of a frame do not depend on later frames.

    The patch of a square is drawn at random with a fixed seed: equal places in all frames would leave a grid.
    """
    h, w = grid
    kept = np.zeros((S, special_tokens + h * w), bool)
    kept[0], kept[:, :special_tokens] = True, True
    generator = np.random.default_rng(0)
    tops, lefts = (axis.ravel() for axis in np.meshgrid(np.arange(0, h, region), np.arange(0, w, region)))
    for frame in kept[1:, special_tokens:]:
        rows = tops + generator.integers(np.minimum(region, h - tops))
        columns = lefts + generator.integers(np.minimum(region, w - lefts))
        frame[rows * w + columns] = True
    if stride is not None:
        kept.reshape(-1)[::stride] = True
    return np.flatnonzero(kept)


class _Merged(NamedTuple):
    q: Float[Array, "G N D"]
    k: Float[Array, "K N D"]
    v: Float[Array, "K N D"]
    counts: Float[Array, " K"]  # real, unsuppressed tokens of each key
    groups: Int[Array, " T"]  # every token's group


def _groups(metric: Float[Array, "T C"], kept: Int[np.ndarray, " G"], real: Bool[Array, " T"]) -> Int[Array, " T"]:
    """Return the group of every token: a kept token's own, or that of the most similar real kept token."""
    T = len(metric)
    others = np.setdiff1d(np.arange(T), kept)
    groups = jnp.zeros(T, jnp.int32).at[kept].set(np.arange(len(kept), dtype=np.int32))
    if not len(others):
        return groups
    # A token's own length does not change which key is the most similar one, so it divides only the kept keys' columns.
    targets = metric[kept].T
    lengths = jnp.maximum(jnp.linalg.norm(upcast(targets), axis=0), 1e-12)
    is_real = real[kept][None]

    def most_similar(rows: Float[Array, "R C"]) -> Int[Array, " R"]:
        products = jnp.matmul(rows, targets, preferred_element_type=lengths.dtype) / lengths[None]
        return jnp.argmax(jnp.where(is_real, products, -jnp.inf), axis=1).astype(jnp.int32)

    chunks = math.ceil(len(others) / _ROWS_AT_ONCE)
    rows = jnp.pad(metric[others], ((0, -len(others) % chunks), (0, 0))).reshape(chunks, -1, metric.shape[1])
    return groups.at[others].set(jax.lax.map(most_similar, rows).reshape(-1)[: len(others)])


class _GroupMeans:
    """Means of each group over those of its tokens that count; 0 for a group without any."""

    def __init__(self, kept: Int[np.ndarray, " G"], groups: Int[Array, " T"], counted: Bool[Array, " T"]) -> None:
        self._kept, self._groups, self._counted = kept, groups, counted
        self._others = np.setdiff1d(np.arange(groups.shape[0]), kept)
        self.counts = self._sums(counted.astype(jnp.float32))

    def of(self, x: Float[Array, "T N D"]) -> Float[Array, "G N D"]:
        sums = self._sums(jnp.where(self._counted[:, None, None], upcast(x), 0))
        return (sums / jnp.maximum(self.counts, 1)[:, None, None]).astype(x.dtype)

    def _sums(self, x: Float[Array, "T ..."]) -> Float[Array, "G ..."]:
        return x[self._kept].at[self._groups[self._others]].add(x[self._others])


def _counted_attention(
    q: Float[Array, "B T N D"], k: Float[Array, "B K N D"], v: Float[Array, "B K N D"], counts: Float[Array, "B K"]
) -> Float[Array, "B T N D"]:
    """Return attention in which a key stands for `counts` equal keys: log(counts) is added to its logits.

    The sum is a part of the product: a channel that is 1 in q. So every kernel can compute it.
    """
    D = q.shape[-1]
    wide = D + _BIAS_CHANNELS
    bias = jnp.log(jnp.maximum(counts, 1)).astype(k.dtype)[:, :, None, None] * math.sqrt(wide)

    def widen(x: Float[Array, "B T N D"], channel: Array) -> Float[Array, "B T N W"]:
        channel = jnp.broadcast_to(channel, (*x.shape[:3], 1))
        return jnp.pad(jnp.concatenate([x, channel], axis=-1), ((0, 0),) * 3 + ((0, _BIAS_CHANNELS - 1),))

    one, zero = jnp.ones((1, 1, 1, 1), q.dtype), jnp.zeros((1, 1, 1, 1), v.dtype)
    return attention(widen(q * math.sqrt(wide / D), one), widen(k, bias), widen(v, zero), counts > 0)[..., :D]
