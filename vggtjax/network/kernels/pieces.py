"""Map a function of single rows over many rows, in pieces of a size that suits the platform."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.storage.process import core_count

NUMBERS_ON_CPU = 1600 * 1024  # of a piece on two cores: an MLP's hidden rows (26 MB) stay in the cache
ROWS_ELSEWHERE = 2**18  # an MLP's hidden rows take 2 GB in bfloat16; smaller pieces cost kernels and copies
_MULTIPLE = 8  # of rows on an accelerator: cuBLAS takes no others, and XLA pads the inputs of each product
_MOST_TIMES = 8  # as large as on two cores are the pieces of more, at most: it bounds their memory

_Rows = TypeVar("_Rows")
_Outputs = TypeVar("_Outputs")


def map_chunks(function: Callable[[_Rows, int], _Outputs], rows: _Rows) -> _Outputs:
    """Return `function(rows, R)` for a tree of arrays [R, C], ..., with the intermediate values of a piece at a time.

    The function must treat every row independently. Few rows take a single call, without a loop. On an accelerator it
    is given up to seven rows of zeros more than the number that it is given, and returns that number of rows.
    """
    if _count(rows) <= _rows_on_cpu(rows):  # the code below is traced for every platform
        return function(rows, _count(rows))

    def in_pieces(most: int, multiple: int) -> Callable[[_Rows], _Outputs]:
        def mapped(rows):
            count = _count(rows)
            if (size := piece_size(count, most, multiple)) is None:
                return function(_padded(rows, multiple), count)
            outputs = jax.lax.map(lambda piece: function(piece, size), _cut(rows, size))
            return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], outputs)

        return mapped

    return _by_platform(in_pieces, rows)


def map_chunks_in_place(
    function: Callable[[Float[Array, "r C"], _Rows], Float[Array, "r C"]], x: Float[Array, "R C"], others: _Rows
) -> Float[Array, "R C"]:
    """Return `function(x, others)` as `map_chunks` does; each piece overwrites its own input."""
    if len(x) <= _rows_on_cpu(x):
        return function(x, others)

    def in_pieces(most: int, multiple: int):
        def replaced(rows):
            if (size := piece_size(len(x), most, multiple)) is None:
                return function(*_padded(rows, multiple))[: len(x)]
            pieces, others = _cut(rows, size)

            def step(pieces, index_and_others):
                index, others = index_and_others
                return pieces.at[index].set(function(pieces[index], others)), None

            pieces, _ = jax.lax.scan(step, pieces, (jnp.arange(len(pieces)), others))
            return pieces.reshape(-1, x.shape[1])[: len(x)]

        return replaced

    return _by_platform(in_pieces, (x, others))


def times_for_cores() -> int:
    """Return how many times as large as on two cores a piece is on a CPU, so that every core has as much of it."""
    return min(max(core_count() // 2, 1), _MOST_TIMES)


def largest_divisor(count: int, most: int) -> int:
    """Return the largest divisor of `count` up to `most`: equal pieces need no second compilation for a remainder."""
    return max(n for n in range(1, min(count, most) + 1) if count % n == 0)


def piece_size(count: int, most: int, multiple: int = 1) -> int | None:
    """Return the size of equal pieces of `count` rows, or None for a single piece.

    A divisor between `most` / 3 and `most`, which avoids a padded copy, or else the size of the fewest pieces. The
    divisor is a multiple of `multiple` where there is one: a padded copy would cost more than products of other sizes.
    """
    if count <= most:
        return None
    fewest = -(-count // most)
    divisors = [count // n for n in range(fewest, 3 * fewest + 1) if count % n == 0]
    best = [size for size in divisors if size % multiple == 0] or divisors or [-(-count // fewest)]
    return best[0]


def _by_platform(in_pieces, rows):
    elsewhere = in_pieces(ROWS_ELSEWHERE, _MULTIPLE)
    return jax.lax.platform_dependent(rows, cpu=in_pieces(_rows_on_cpu(rows), 1), default=elsewhere)


def _rows_on_cpu(rows) -> int:
    return max(times_for_cores() * NUMBERS_ON_CPU // jax.tree.leaves(rows)[0].shape[1], 1)


def _count(rows) -> int:
    return jax.tree.leaves(rows)[0].shape[0]


def _cut(rows, size: int):
    return jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), _padded(rows, size))


def _padded(rows, multiple: int):
    """Return the rows with rows of zeros after them, up to a multiple."""

    def padded(x):
        padding = -x.shape[0] % multiple
        return jnp.pad(x, ((0, padding), *((0, 0),) * (x.ndim - 1))) if padding else x

    return jax.tree.map(padded, rows)
