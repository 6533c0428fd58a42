"""Mapping a function of single rows over many of them, as many at a time as the platform works well with."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

ROWS_ON_CPU = 1600  # the hidden rows of an MLP (26 MB for VGGT) stay in the cache, and products are at their fastest
ROWS_ELSEWHERE = 2**15

_Rows = TypeVar("_Rows")
_Made = TypeVar("_Made")


def in_pieces(function: Callable[[_Rows], _Made], rows: _Rows) -> _Made:
    """Return what `function` makes of `rows`, a tree of arrays [R, ...], without holding all that it needs in between.

    The function must treat every row by itself. Few rows go in one call, without a loop.
    """

    def mapped(most: int) -> Callable[[_Rows], _Made]:
        return lambda rows: _mapped(function, rows, most)

    return jax.lax.platform_dependent(rows, cpu=mapped(ROWS_ON_CPU), default=mapped(ROWS_ELSEWHERE))


def _mapped(function, rows, most: int):
    count = jax.tree.leaves(rows)[0].shape[0]
    if count <= most:
        return function(rows)
    size = piece_size(count, most)
    padding = -count % size

    def cut(x):
        x = jnp.pad(x, ((0, padding), *((0, 0),) * (x.ndim - 1))) if padding else x
        return x.reshape(-1, size, *x.shape[1:])

    made = jax.lax.map(function, jax.tree.map(cut, rows))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], made)


def piece_size(count: int, most: int) -> int:
    """Return the size of equal pieces of `count` rows: a divisor between `most` / 3 and `most`, which spares a padded
    copy, or else the size of the fewest pieces."""
    fewest = -(-count // most)
    divisors = (count // n for n in range(fewest, 3 * fewest + 1) if count % n == 0)
    return next(divisors, -(-count // fewest))
