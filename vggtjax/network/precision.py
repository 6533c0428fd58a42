"""Float32 means float32: matrix products at full precision, whatever the accelerator's default."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.errors import InputError

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


def check_compute_dtype(name: str) -> None:
    """Raise InputError for a type that the blocks do not compute in."""
    if name not in ("float32", "bfloat16", "float64"):
        raise InputError(f"compute_dtype is {name!r}; expected 'float32' or 'bfloat16'")
    if name == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError("compute_dtype is 'float64', which jax computes in only after jax.enable_x64(True)")


def widened(x: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Return x in float32, or in float64 if it is in that: what sums and residual streams are kept in."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def full_precision(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Trace `function` with every matrix product and convolution at the highest precision (never TF32).

    The setting holds while `function` is traced and is gone afterwards; nothing global changes.
    """

    @functools.wraps(function)
    def wrapped(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return wrapped
