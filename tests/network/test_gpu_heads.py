"""The kernel for q, k and v on GPUs, in Pallas's interpreter, beside what a CPU computes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax.network import gpu_heads
from vggtjax.network.block import Projections
from vggtjax.network.layers import apply
from vggtjax.network.rope import rope_table

HEADS, SIZE = 2, 16
ROPE = rope_table((2, 3), 1, SIZE)  # seven rows


@pytest.fixture(params=["float32", "bfloat16"])
def case(request):
    """q, k and v of eight rows, the last one for padding; norms; and the same as q, k and v of a CPU."""
    generator = np.random.default_rng(0)
    channels = HEADS * SIZE
    y, norms = (generator.standard_normal(shape, np.float32) for shape in ((8, 3 * channels), (2, 2, SIZE)))
    y = np.asarray(jnp.asarray(y, request.param), np.float32)
    identity = {"kernel": np.eye(3 * channels, dtype=np.float32), "bias": np.zeros(3 * channels, np.float32)}
    params = {
        "qkv": identity,
        "projection": {"kernel": np.eye(channels), "bias": np.zeros(channels)},
        **{name: dict(zip(("scale", "bias"), norms[i], strict=True)) for i, name in enumerate(("q_norm", "k_norm"))},
    }
    layers = Projections(HEADS, channels, qk_norm=True, dtype=jnp.dtype(request.param))
    wanted = apply(layers, params, y, ROPE, len(ROPE.cos), method="heads")
    return jnp.asarray(y, request.param).reshape(8, 3, HEADS, SIZE), jnp.asarray(norms), wanted


def test_the_kernel_gives_the_heads_of_a_cpu(case):
    y, norms, wanted = case
    made = gpu_heads.fused_heads(y, norms, ROPE, interpret=True)
    for a, b in zip(made, wanted, strict=True):
        assert a.shape == (7, HEADS, SIZE)
        assert a.dtype == b.dtype
        assert np.abs(np.asarray(a - b, np.float32)).max() < (1e-5 if a.dtype == jnp.float32 else 0.06)


def test_the_gradient_of_the_kernel(case, monkeypatch):
    y, norms, _ = case
    y = y.astype(jnp.float32)
    monkeypatch.setattr(gpu_heads, "fused_heads", partial(gpu_heads.fused_heads, interpret=True))

    def loss(heads, y, norms):
        return sum(jnp.sum(jnp.sin(x)) for x in heads(y, norms, ROPE))

    wanted = jax.grad(partial(loss, gpu_heads.heads_by_xla), (0, 1))(y, norms)
    made = jax.grad(partial(loss, gpu_heads.normed_heads), (0, 1))(y, norms)
    assert all(np.abs(a - b).max() < 1e-5 for a, b in zip(made, wanted, strict=True))
    assert not np.any(made[0][7])  # a row of padding


@pytest.mark.parametrize(("heads", "size", "fused"), [(16, 64, True), (2, 4, True), (12, 64, False), (2, 2, False)])
def test_which_heads_the_kernel_takes(heads, size, fused):
    assert gpu_heads.is_fused(heads, size) == fused
