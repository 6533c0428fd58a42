"""Numbers of an untrusted JSON object. Does not import jax."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from vggtjax.errors import InputError


def numbers(
    values: Mapping[str, Any], key: str, shapes: tuple[tuple[int, ...], ...], source: Path, *, finite: bool = True
) -> Float64[np.ndarray, ...]:
    """Return a field as an array of one of the shapes; -1 is any length.

    Raises InputError, which names `source`, for a field that is missing, not of numbers, not `finite`, or of another
    shape.
    """
    try:
        if values[key] is None:  # numpy reads it as not a number
            raise TypeError
        array = np.asarray(values[key], np.float64)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        raise InputError(f"{source} has no numbers under '{key}'; expected them of shape {_words(shapes)}") from None
    fits = any(
        array.ndim == len(shape) and all(want in (-1, side) for want, side in zip(shape, array.shape, strict=True))
        for shape in shapes
    )
    if not fits or (finite and not np.isfinite(array).all()):
        raise InputError(
            f"{source} has a '{key}' of shape {array.shape}; expected finite numbers of shape {_words(shapes)}"
        )
    return array


def number(values: Mapping[str, Any], key: str, source: Path, default: float | None = None) -> float:
    """Return a finite number, or the default for a missing key; raises InputError as `numbers`."""
    if key not in values and default is not None:
        return default
    return float(numbers(values, key, ((),), source))


def _words(shapes: tuple[tuple[int, ...], ...]) -> str:
    return " or ".join(str(shape) for shape in shapes)
