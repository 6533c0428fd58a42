"""The gradient of the heads' convolution on a CPU, against XLA's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax.network.kernels import cpu_convolution
from vggtjax.network.kernels.cpu_convolution import same_convolution


@pytest.mark.parametrize(  # a row, a few rows, everything
    ("at_once", "size"), [(1, (3, 3)), (300, (3, 3)), (10**6, (3, 3)), (300, (5, 1))]
)
def test_gradient_against_xlas_own(at_once, size, monkeypatch):
    monkeypatch.setattr(cpu_convolution, "_NUMBERS_AT_ONCE", at_once)
    generator = np.random.default_rng(0)
    x, kernel, upstream = (
        jnp.asarray(generator.normal(size=shape), jnp.float32) for shape in ((4, 6, 5, 3), (*size, 3, 2), (4, 6, 5, 2))
    )

    def by_xla(x, kernel):
        return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))

    expected, pull = jax.vjp(by_xla, x, kernel)
    made, pull_made = jax.vjp(same_convolution, x, kernel)
    assert np.array_equal(made, expected)
    for gradient, right in zip(pull_made(upstream), pull(upstream), strict=True):
        assert np.abs(gradient - right).max() < 2e-6 * np.abs(right).max()


def test_precision_of_the_forward_pass_is_that_of_the_gradient():
    x, kernel = jnp.ones((1, 3, 3, 1)), jnp.ones((3, 3, 1, 1))
    with jax.default_matmul_precision("highest"):
        _, pull = jax.vjp(same_convolution, x, kernel)
    text = jax.jit(pull).lower(x).as_text()
    products = [line for line in text.splitlines() if "convolution(" in line or "dot_general " in line]
    assert products
    assert all("HIGHEST" in line for line in products)
