"""What is stored of tapped pairs of blocks: a function of the outputs of the frame and the global block, joined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

ROWS_AT_ONCE = 2**16  # of tokens on an accelerator: they take 0.5 GB in float32

Capture = Callable[[Float[Array, "B S T E"]], Any]


def joined(capture: Capture, shape: tuple[int, int, int, int]) -> Callable[[Array, Array], Any]:
    """Return what captures a tapped pair: its frame and global outputs, joined; on an accelerator some frames at once.

    The rows of many frames, joined and normalised in float32, would be the most that a pass holds.
    """
    B, S, T = shape[:3]
    pieces = -(-S // max(ROWS_AT_ONCE // (B * T), 1))
    at_once = -(-S // pieces)
    starts = np.minimum(at_once * np.arange(pieces), S - at_once)  # the last piece overlaps the one before it
    owner = np.minimum(np.arange(S) // at_once, pieces - 1)
    taken = at_once * owner + np.arange(S) - starts[owner]  # of every frame, among those of all pieces

    def captured(frame: Array, x: Array) -> Any:
        return capture(jnp.concatenate([frame.reshape(shape), x.reshape(shape)], axis=-1))

    def in_pieces(frame: Array, x: Array) -> Any:
        def of_piece(start: Array) -> Any:
            some = [jax.lax.dynamic_slice_in_dim(a.reshape(shape), start, at_once, axis=1) for a in (frame, x)]
            return capture(jnp.concatenate(some, axis=-1))

        def of_frames(leaf: Array) -> Array:
            leaf = jnp.moveaxis(leaf, 0, 1).reshape(B, pieces * at_once, *leaf.shape[3:])
            return leaf if pieces * at_once == S else leaf[:, taken]

        return jax.tree.map(of_frames, jax.lax.map(of_piece, jnp.asarray(starts)))  # [pieces, B, at once, ...]

    if pieces == 1:
        return captured
    return lambda frame, x: jax.lax.platform_dependent(frame, x, cpu=captured, default=in_pieces)


def nothing_captured(captures: Sequence[Capture], shape: tuple[int, ...], dtype: Any) -> tuple[Any, ...]:
    """Return the zeros that taps are before their pairs, for tokens of a shape [B, S, T, 2C]."""
    shapes = (jax.eval_shape(capture, jax.ShapeDtypeStruct(shape, dtype)) for capture in captures)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), tuple(shapes))
