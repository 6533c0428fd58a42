"""Sampled keys in global attention (after AVGGT, arXiv 2512.02541): an approximation, the faster the more frames.

In the first pairs of blocks global attention sees the own frame alone. In later pairs every query sees the whole first
frame, and of every other frame the special tokens, one patch of each square and every tenth token. Queries are not
sampled, so every token keeps an output of its own. Motion cues read queries and keys before they are sampled.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.network.suppression import Attend, SuppressedKeys, suppressed_attention

EARLY = 9 / 24  # share of the pairs, from the first, whose global attention sees the own frame alone
SQUARE = 2  # patches a side of the squares of which one patch is seen
STRIDE = 10  # every tenth token is seen as well


def sampled_attention(S: int, grid: tuple[int, int], special_tokens: int, *, square: int = SQUARE) -> Attend:
    """Return attention over S frames in place of `suppressed_attention`, to sampled keys.

    Suppressed keys, and tokens that are not real, are sampled as the others are.

    Args:
        S: number of frames.
        grid: rows and columns of patches of a frame, h and w.
        special_tokens: tokens before a frame's patches.
        square: patches a side of the squares; 1 keeps every key, and equals exact attention.
    """
    kept = sampled_tokens(S, grid, special_tokens, square)

    def attend(
        q: Float[Array, "B T N D"],
        k: Float[Array, "B T N D"],
        v: Float[Array, "B T N D"],
        suppressed: SuppressedKeys | None,
        is_real: Bool[Array, "B T"] | None = None,
    ) -> Float[Array, "B T N D"]:
        if suppressed is not None:
            suppressed = SuppressedKeys(suppressed.hidden[:, kept], suppressed.active, suppressed.suppress)
        is_real = None if is_real is None else is_real[:, kept]
        return suppressed_attention(q, k[:, kept], v[:, kept], suppressed, is_real)

    return attend


def sampled_tokens(
    S: int, grid: tuple[int, int], special_tokens: int, square: int = SQUARE, stride: int | None = STRIDE
) -> Int[np.ndarray, " K"]:
    """Return the tokens whose keys are seen, in rising order; those of a frame do not depend on later frames.

    The grid moves from frame to frame, through all patches of a square: one that stays would hide the others.
    """
    kept = np.zeros((S, special_tokens + grid[0] * grid[1]), bool)
    kept[0], kept[:, :special_tokens] = True, True
    for number, frame in enumerate(kept[1:, special_tokens:], start=1):
        row, column = (start % square for start in (number // square, number))
        frame.reshape(grid)[row::square, column::square] = True
    if stride is not None:
        kept.reshape(-1)[::stride] = True
    return np.flatnonzero(kept)


def early_pairs(depth: int) -> Bool[np.ndarray, " depth"]:
    """Return in which of `depth` pairs global attention sees the own frame alone."""
    return np.arange(depth) < int(EARLY * depth)


def frames_alone(S: int, attend: Attend, early: Bool[Array, ""]) -> Attend:
    """Return attention that sees the own frame alone where the pair's flag is set, and `attend` elsewhere.

    The flag is a scalar per pair, so the choice is a branch, not a select. A padded frame sees itself: nobody reads it.
    """

    def either(q, k, v, suppressed, is_real=None):
        suppress = None if suppressed is None else suppressed.suppress
        inputs = (q, k, v, None if suppressed is None else (suppressed.hidden, suppressed.active))

        def keys(hidden: Any) -> SuppressedKeys | None:
            return None if suppress is None else SuppressedKeys(hidden[0], hidden[1], suppress)

        def alone(q, k, v, hidden):
            queries, own, values = (x.reshape(-1, x.shape[1] // S, *x.shape[2:]) for x in (q, k, v))
            if hidden is not None:
                hidden = (hidden[0].reshape(queries.shape[:2]), hidden[1])
            return suppressed_attention(queries, own, values, keys(hidden)).reshape(q.shape)

        def together(q, k, v, hidden):
            return attend(q, k, v, keys(hidden), is_real)

        with jax.named_scope("early"):
            return jax.lax.cond(early, alone, together, *inputs)

    return either
