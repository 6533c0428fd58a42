"""Block-sparse attention that keeps all blocks, and bad input of the benchmark."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.block_sparse import sparse_attention
from vggtjax.network.suppression import SuppressedKeys, suppressed_attention

S, GRID, SPECIAL, N, D = 3, (2, 5), 2, 2, 8
T, QUERIES, KEYS = SPECIAL + 10, 4, 3


def draw():
    generator = np.random.default_rng(0)
    q, k, v = (jnp.asarray(generator.normal(size=(1, S * T, N, D)), jnp.float32) for _ in range(3))
    return q, k, v, generator.random((1, S * T)) < 0.3


@pytest.mark.parametrize("suppress", ["zero", "drop"])
def test_keeping_all_blocks_is_exact(suppress):
    q, k, v, hidden = draw()
    keys = SuppressedKeys(jnp.asarray(hidden), jnp.asarray(True), suppress)
    real = jnp.asarray(np.arange(S * T)[None] < 2 * T)
    sparse = sparse_attention(S, GRID, SPECIAL, keep=1.0, queries=QUERIES, keys=KEYS)(q, k, v, keys, real)
    assert np.abs(np.asarray(sparse) - np.asarray(suppressed_attention(q, k, v, keys, real)))[:, : 2 * T].max() < 2e-6


def test_bad_input_is_one_sentence(capsys):
    assert benchmarks.main(["approximations", "--scenes", "0"]) == 2
    assert "expected at least 1" in capsys.readouterr().err
