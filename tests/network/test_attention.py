"""Attention as computed on every platform, against the formula written out."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.pallas import tpu

from vggtjax.network.kernels import attention, cpu_attention
from vggtjax.network.kernels.cpu_attention import attention_in_chunks


def _formula(q, k, v, kept):
    logits = np.einsum("btnd,bknd->bntk", q, k, dtype=np.float64) / np.sqrt(q.shape[-1])
    logits = np.where(kept[:, None, None, :], logits, -np.inf)
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    return np.einsum("bntk,bknd->btnd", weights / weights.sum(-1, keepdims=True), v)


@pytest.mark.parametrize(
    ("implementation", "at_once"),
    [
        (attention._at_once, 0),
        (cpu_attention.attention_in_chunks, 0),
        (cpu_attention.attention_in_chunks, 1000),
        (attention.attention, 1000),
    ],
)
@pytest.mark.parametrize("masked", [False, True])
def test_equals_the_formula(monkeypatch, implementation, masked, at_once):
    monkeypatch.setattr(cpu_attention, "QUERIES_AT_ONCE", 4)  # 11 queries: three chunks, one padded
    monkeypatch.setattr(cpu_attention, "LOGITS_OF_ALL_HEADS", at_once)
    generator = np.random.default_rng(0)
    q, k, v = (generator.normal(size=(2, 11, 3, 8)).astype(np.float32) for _ in range(3))
    kept = generator.random((2, 11)) < 0.6 if masked else np.ones((2, 11), bool)
    with jax.default_matmul_precision("highest"):
        made = implementation(*map(jnp.asarray, (q, k, v)), kept if masked else None)
    assert np.abs(np.asarray(made) - _formula(q, k, v, kept)).max() < 1e-5


@pytest.mark.parametrize("masked", [False, True])
def test_the_gradient_is_that_of_jaxs_own_attention(monkeypatch, masked):
    monkeypatch.setattr(cpu_attention, "QUERIES_AT_ONCE", 4)
    monkeypatch.setattr(cpu_attention, "LOGITS_OF_ALL_HEADS", 0)
    generator = np.random.default_rng(1)
    q, k, v, weight = (generator.normal(size=(2, 11, 3, 8)).astype(np.float32) for _ in range(4))
    kept = generator.random((2, 11)) < 0.6 if masked else None

    def gradient(implementation):
        slope = jax.grad(lambda *x: (implementation(*x, kept) * weight).sum(), argnums=(0, 1, 2))
        return jax.jit(slope)(*map(jnp.asarray, (q, k, v)))

    with jax.default_matmul_precision("highest"):
        for made, expected in zip(
            gradient(cpu_attention.attention_in_chunks), gradient(attention._at_once), strict=True
        ):
            assert np.abs(made - expected).max() < 2e-6


@pytest.mark.parametrize("masked", [False, True])
def test_packed_keys(masked):
    """What cuDNN is given: kept keys first, and their number. Here jax's own kernel stops there."""
    generator = np.random.default_rng(2)
    q, k, v = (jnp.asarray(generator.normal(size=(2, 11, 3, 8)), jnp.float32) for _ in range(3))
    kept = generator.random((2, 11)) < 0.6 if masked else np.ones((2, 11), bool)
    with jax.default_matmul_precision("highest"):
        made = attention._packed(q, k, v, jnp.asarray(kept) if masked else None, implementation="xla")
    assert np.abs(np.asarray(made) - _formula(q, k, v, kept)).max() < 1e-5


@pytest.mark.proof
def test_the_kernel_for_tpus_interpreted():
    generator = np.random.default_rng(3)
    q, k, v = (jnp.asarray(generator.normal(size=(1, 140, 2, 64)), jnp.float32) for _ in range(3))
    kept = generator.random((1, 140)) < 0.6
    with tpu.force_tpu_interpret_mode(), jax.default_matmul_precision("highest"):
        made = attention._on_tpu(q, k, v, jnp.asarray(kept))
    assert np.abs(np.asarray(made) - _formula(q, k, v, kept)).max() < 1e-5


@pytest.mark.parametrize("most", [10**6, 4 * 3 * 13 * 5, 100])  # all queries at once, five of eleven, one
def test_what_does_not_fit_at_once_is_cut(monkeypatch, most):
    monkeypatch.setattr(attention, "LOGITS_AT_ONCE", most)
    generator = np.random.default_rng(4)
    q, k, v = (jnp.asarray(generator.normal(size=(4, length, 3, 8)), jnp.float32) for length in (11, 13, 13))
    kept = generator.random((4, 13)) < 0.6
    with jax.default_matmul_precision("highest"):
        made = attention._at_once_or_in_chunks(q, k, v, jnp.asarray(kept))
    assert np.abs(np.asarray(made) - _formula(q, k, v, kept)).max() < 1e-5


@pytest.mark.parametrize(("cores", "times"), [(2, 1), (4, 2), (128, 8)])
def test_chunks_grow_with_the_cores_but_not_without_bound(monkeypatch, cores, times):
    monkeypatch.setattr("vggtjax.network.kernels.pieces.core_count", lambda: cores)
    queries = jnp.zeros((12_800, 1))
    assert cpu_attention._chunks(queries, keys=5000).shape == (16 // times, 800 * times, 1)
    assert cpu_attention._chunks(queries, keys=10**6).shape == (16, 800, 1)


@pytest.mark.parametrize("masked", [False, True])
def test_odd_numbers_of_tokens_become_even(masked):
    """cuDNN's gradient takes even ones alone; XLA computes here."""
    generator = np.random.default_rng(0)
    q, k, v = (jnp.asarray(generator.standard_normal((2, n, 2, 8), np.float32)) for n in (7, 9, 9))
    visible = jnp.asarray(generator.random((2, 9)) < 0.7).at[:, 0].set(True) if masked else None

    def loss(attend, *inputs):
        return (attend(*inputs, visible) * q).sum()

    wanted = jax.value_and_grad(partial(loss, attention_in_chunks), (0, 1, 2))(q, k, v)
    made = jax.value_and_grad(partial(loss, partial(attention.evened, implementation="xla")), (0, 1, 2))(q, k, v)
    assert jax.tree.all(jax.tree.map(lambda a, b: np.allclose(a, b, atol=1e-5), made, wanted))
