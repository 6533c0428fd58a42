"""Bilinear resizing with aligned corners, whose gradient is fast on a CPU."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def resize_aligned(x: Float[Array, "F h w C"], size: tuple[int, int]) -> Float[Array, "F H W C"]:
    """Resize bilinearly with aligned corners: the centres of corner pixels map onto each other."""
    for axis, length in zip((1, 2), size, strict=True):
        if x.shape[axis] != length:
            x = _resize_axis(x, axis, length)
    return x


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def _resize_axis(x: Float[Array, "F h w C"], axis: int, length: int) -> Float[Array, "F H W C"]:
    low, high, fraction = _neighbours(x.shape[axis], length)
    fraction = jnp.asarray(fraction.reshape([length if i == axis else 1 for i in range(4)]), x.dtype)
    return jnp.take(x, low, axis=axis) * (1 - fraction) + jnp.take(x, high, axis=axis) * fraction


def _resize_axis_forward(x, axis: int, length: int):
    return _resize_axis(x, axis, length), x.shape[axis]


def _resize_axis_backward(axis: int, length: int, size: int, gradient):
    """Multiply by the transposed interpolation: the gather's own gradient is a scatter, which is slow on a CPU."""
    low, high, fraction = _neighbours(size, length)
    weights = np.zeros((length, size), np.float32)
    np.add.at(weights, (np.arange(length), low), 1 - fraction)
    np.add.at(weights, (np.arange(length), high), fraction)
    letters = "fhwc"
    equation = f"fhwc,{letters[axis]}n->{letters.replace(letters[axis], 'n')}"
    return (jnp.einsum(equation, gradient, jnp.asarray(weights, gradient.dtype)),)


_resize_axis.defvjp(_resize_axis_forward, _resize_axis_backward)


def _neighbours(size: int, length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two source positions of every target position, and the share of the second."""
    position = np.arange(length, dtype=np.float32) * np.float32((size - 1) / max(length - 1, 1))
    low = np.minimum(position.astype(np.int32), size - 1)
    return low, np.minimum(low + 1, size - 1), position - low
