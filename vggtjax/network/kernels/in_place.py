"""What a loop over layers carries and changes in some of them only, in place.

A conditional copies what it returns unchanged, in every layer. A loop of one step or none leaves it where it is in
memory; it has a gradient here, in reverse mode only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

_Tree = TypeVar("_Tree")


def replaced_if(flag: Bool[Array, ""], old: _Tree, function: Callable[..., _Tree], *inputs: Array) -> _Tree:
    """Return `function(*inputs)` if the flag is true, else `old`.

    The function may read other arrays of floats, by which it has gradients too; other integers have to be inputs.
    """
    function, others = jax.closure_convert(function, *inputs)
    return _updated(function, False, flag, old, *inputs, *others)


def added_if(flag: Bool[Array, ""], old: _Tree, function: Callable[..., _Tree], *inputs: Array) -> _Tree:
    """Return `old + function(*inputs)` if the flag is true, else `old`; otherwise as `replaced_if`."""
    function, others = jax.closure_convert(function, *inputs)
    return _updated(function, True, flag, old, *inputs, *others)


def _known_within(x: Array, number: Array) -> Array:
    """Return x, which is known when the loop runs: else XLA moves the function out of it, and computes it always.

    Integers stay as they are: with devices that share frames, they have to stay equal on all.
    """
    is_float = jnp.issubdtype(x.dtype, jnp.inexact) and x.ndim > 0
    return jax.lax.optimization_barrier((x, number))[0] if is_float else x


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _updated(function, adds, flag, old, *inputs):
    def step(number, old):
        new = function(*(_known_within(x, number) for x in inputs))
        return jax.tree.map(jnp.add, old, new) if adds else new

    return jax.lax.fori_loop(0, flag.astype(jnp.int32), step, old)


def _forward(function, adds, flag, old, *inputs):
    return _updated(function, adds, flag, old, *inputs), (flag, inputs)


def _backward(function, adds, residuals, gradient):
    flag, inputs = residuals
    is_real = [jnp.issubdtype(x.dtype, jnp.inexact) for x in inputs]
    real = [x for x, counts in zip(inputs, is_real, strict=True) if counts]

    def of_real(*real: Array) -> Any:
        given = iter(real)
        return function(*(next(given) if counts else x for x, counts in zip(inputs, is_real, strict=True)))

    def changed(gradient: Any) -> Any:
        of_old = gradient if adds else jax.tree.map(jnp.zeros_like, gradient)
        return of_old, jax.vjp(of_real, *real)[1](gradient)

    def unchanged(gradient: Any) -> Any:
        return gradient, tuple(map(jnp.zeros_like, real))

    of_old, of_inputs = jax.lax.cond(flag, changed, unchanged, gradient)
    found = iter(of_inputs)
    return None, of_old, *(next(found) if counts else None for counts in is_real)


_updated.defvjp(_forward, _backward)
