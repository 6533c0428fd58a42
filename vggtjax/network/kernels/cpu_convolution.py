"""Convolution of images whose gradient by the kernel is fast on a CPU."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vggtjax.network.kernels.pieces import largest_divisor
from vggtjax.network.precision import upcast

_NUMBERS_AT_ONCE = 3 * 2**19  # of the shifted input that one product reads (6 MB): they stay in the cache


def same_convolution(
    x: Float[Array, "F H W C"], kernel: Float[Array, "a b C O"], *_: Any, precision: Any = None, **__: Any
) -> Float[Array, "F H W O"]:
    """Return the convolution with a kernel of odd size and stride 1, with zeros around x: `nn.Conv` with "SAME".

    On a CPU the gradient by the kernel is a sum of matrix products. XLA's own is a convolution whose window is the
    whole image, which it runs on one core.
    """
    default = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]
    return _convolution(x, kernel, precision or default)


def _by_xla(x, kernel, precision):
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"), precision=precision
    )


_convolution = jax.custom_vjp(_by_xla, nondiff_argnums=(2,))


def _forward(x, kernel, precision):
    return _by_xla(x, kernel, precision), (x, kernel)


def _backward(precision, residuals, gradient):
    x, kernel = residuals

    def by_xla(x, gradient):
        return jax.vjp(lambda kernel: _by_xla(x, kernel, precision), kernel)[1](gradient)[0]

    def by_products(x, gradient):
        total = _kernel_gradient(x, gradient, kernel.shape[:2], precision)
        # Devices with other images share the kernel: the transpose of sharing it is the sum over them.
        one = jnp.where(gradient[0, 0, 0, 0] == 0, 1, 1).astype(total.dtype)
        return jax.vjp(lambda kernel: one * kernel, kernel)[1](total)[0]

    (to_x,) = jax.vjp(lambda x: _by_xla(x, kernel, precision), x)[1](gradient)
    return to_x, jax.lax.platform_dependent(x, gradient, cpu=by_products, default=by_xla)


_convolution.defvjp(_forward, _backward)


def _kernel_gradient(
    x: Float[Array, "F H W C"], gradient: Float[Array, "F H W O"], size: tuple[int, int], precision: Any
) -> Float[Array, "a b C O"]:
    """Return the sum over pixels of shifted inputs times gradients, of a few images or rows of an image at once.

    Inputs shifted along a row stand side by side, and so do gradients shifted along a column: their product has all
    shifts, and is large enough to be fast.
    """
    (F, H, W, C), (a, b), outputs = x.shape, size, gradient.shape[-1]
    x = jnp.pad(x, ((0, 0), (a // 2, a // 2), (b // 2, b // 2), (0, 0)))
    rows = largest_divisor(H, max(_NUMBERS_AT_ONCE // (W * b * C), 1))
    images = largest_divisor(F, max(_NUMBERS_AT_ONCE // (rows * W * b * C), 1)) if rows == H else 1

    def product(place):
        start = (*place, 0, 0)
        block = jax.lax.dynamic_slice(x, start, (images, rows + a - 1, W + b - 1, C))
        goal = jax.lax.dynamic_slice(gradient, start, (images, rows, W, outputs))
        goal = jnp.pad(goal, ((0, 0), (a - 1, a - 1), (0, 0), (0, 0)))
        shifted = jnp.concatenate([block[:, :, j : j + W] for j in range(b)], axis=-1)
        goals = jnp.concatenate([goal[:, a - 1 - i : 2 * a - 2 - i + rows] for i in range(a)], axis=-1)
        shifted, goals = shifted.reshape(-1, b * C), goals.reshape(-1, a * outputs)
        return jnp.matmul(shifted.T, goals, precision=precision, preferred_element_type=upcast(gradient).dtype)

    places = np.stack(np.meshgrid(range(0, F, images), range(0, H, rows), indexing="ij"), axis=-1).reshape(-1, 2)
    total, _ = jax.lax.scan(lambda total, place: (total + product(place), None), product(places[0]), places[1:])
    return total.reshape(b, C, a, outputs).transpose(2, 0, 1, 3)
