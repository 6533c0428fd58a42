"""The MLP's nonlinearity."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from vggtjax.network.layers import gelu


def test_gelu_and_its_gradient():
    x = np.linspace(-9, 9, 1001)
    value, pull = jax.vjp(gelu, jnp.asarray(x, jnp.float32))
    assert np.abs(value - x * norm.cdf(x)).max() < 1.5e-6
    assert np.abs(pull(jnp.ones(1001))[0] - (norm.cdf(x) + x * norm.pdf(x))).max() < 5e-7
