"""The MLP's nonlinearity, and rows in pieces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from vggtjax.network.kernels import pieces
from vggtjax.network.layers import _fused_gelu, gelu


def test_gelu_and_its_gradient():
    x = np.linspace(-9, 9, 1001)
    value, pull = jax.vjp(gelu, jnp.asarray(x, jnp.float32))
    assert np.abs(value - x * norm.cdf(x)).max() < 1.5e-6
    assert np.abs(pull(jnp.ones(1001))[0] - (norm.cdf(x) + x * norm.pdf(x))).max() < 5e-7


def test_gelu_of_an_accelerator():
    """Its gradient is the exact one."""
    x = np.linspace(-9, 9, 1001)
    value, pull = jax.vjp(_fused_gelu, jnp.asarray(x, jnp.float32))
    assert 1e-4 < np.abs(value - x * norm.cdf(x)).max() < 5e-4
    assert np.abs(pull(jnp.ones(1001))[0] - (norm.cdf(x) + x * norm.pdf(x))).max() < 5e-7


def test_rows_on_an_accelerator_are_a_multiple_of_eight(monkeypatch):
    monkeypatch.setattr(pieces, "_rows_on_cpu", lambda rows: 1)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *inputs, default, **_: default(*inputs))
    seen, x = [], jnp.arange(22.0).reshape(11, 2)

    def doubled(rows, count=None):
        seen.append((rows.shape, count))
        return 2 * rows[:count]

    assert np.array_equal(pieces.map_chunks(doubled, x), 2 * x)
    assert np.array_equal(pieces.map_chunks_in_place(lambda x, others: doubled(x) + others, x, x), 3 * x)
    assert seen == [((16, 2), 11), ((16, 2), None)]


@pytest.mark.parametrize(
    ("frames", "rows"),  # of 1041 tokens
    [(251, None), (252, 131166), (300, 156150), (400, 208200), (1000, 208200)],
)
def test_pieces_of_long_clips_on_an_accelerator(frames, rows):
    """Multiples of 8 where a divisor is one."""
    assert pieces.piece_size(1041 * frames, pieces.ROWS_ELSEWHERE, 8) == rows
