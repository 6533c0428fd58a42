"""The median of values on several devices: exact, by counting, without bringing the values together."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from vggtjax.network.frames import Frames

_BITS = 32


def median_over_frames(values: Float[Array, "B S ..."], frames: Frames = Frames()) -> Float[Array, " B"]:
    """Return the median of each clip's values, NaN left out; NaN without any.

    On several devices the two middle values are found bit by bit, from the numbers of smaller values, and have a
    gradient: equal values share it.
    """
    flat = values.reshape(len(values), -1)
    if frames.mesh is None:
        return jnp.nanmedian(flat, axis=-1)
    if (is_counted := frames.are_counted(values.shape[1])) is not None:
        flat = jnp.where(jnp.repeat(is_counted, flat.shape[1] // values.shape[1])[None], flat, jnp.nan)
    valid = ~jnp.isnan(flat)
    ordered = _ordered(jax.lax.stop_gradient(flat).astype(jnp.float32))
    order = jnp.where(valid, ordered, jnp.uint32(2**_BITS - 1))
    count = frames.sum(valid.sum(axis=1))
    middle = _values_of_ranks(flat, order, valid, jnp.stack([(count - 1) // 2, count // 2]), frames)
    return jnp.where(count > 0, middle.mean(axis=0), jnp.nan)


def _ordered(values: Float[Array, "B N"]) -> UInt32[Array, "B N"]:
    """Return whole numbers in the order of the values."""
    bits = jax.lax.bitcast_convert_type(values, jnp.uint32)
    sign = jnp.uint32(1 << (_BITS - 1))
    return jnp.where(bits >= sign, ~bits, bits | sign)


def _values_of_ranks(flat: Array, order: Array, valid: Array, ranks: Int[Array, "R B"], frames: Frames) -> Array:
    """Return the value [R, B] of each rank: as many values of its clip are smaller."""

    def bit(i, found):
        candidate = found | (jnp.uint32(1) << (_BITS - 1 - i).astype(jnp.uint32))
        smaller = frames.sum((order[None] < candidate[..., None]).sum(axis=-1))
        return jnp.where(smaller <= ranks, candidate, found)

    found = jax.lax.fori_loop(0, _BITS, bit, jnp.zeros(ranks.shape, jnp.uint32))
    equal = valid[None] & (order[None] == found[..., None])
    number = frames.sum(equal.sum(axis=-1)).astype(flat.dtype)
    return frames.sum(jnp.where(equal, flat[None], 0).sum(axis=-1)) / jnp.maximum(number, 1)
