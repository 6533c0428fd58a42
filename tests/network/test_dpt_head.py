"""The dense heads' resize and its gradient; frames at once or in a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.tiny import tiny_model
from vggtjax.network.heads import dpt_head
from vggtjax.network.heads.dpt_head import predict_dense, resize_aligned


@pytest.mark.parametrize("size", [(13, 9), (5, 9), (3, 4), (1, 1)])
def test_resize_against_weights_written_out(size):
    generator = np.random.default_rng(0)
    x = generator.normal(size=(2, 5, 7, 3)).astype(np.float32)
    weights = []
    for n, length in zip(x.shape[1:3], size, strict=True):
        position = np.linspace(0, n - 1, length) if length > 1 else np.zeros(1)
        weights.append(np.maximum(0, 1 - np.abs(position[:, None] - np.arange(n)[None])))
    upstream = generator.normal(size=(2, *size, 3)).astype(np.float32)
    made, pull = jax.vjp(lambda x: resize_aligned(x, size), jnp.asarray(x))
    assert np.abs(made - np.einsum("ah,bw,fhwc->fabc", *weights, x)).max() < 1e-5
    (gradient,) = pull(jnp.asarray(upstream))
    assert np.abs(gradient - np.einsum("ah,bw,fabc->fhwc", *weights, upstream)).max() < 1e-4


def test_a_loop_over_frames_changes_nothing(monkeypatch):
    model = tiny_model()
    params, config = model.params["depth_head"], model.config
    generator = np.random.default_rng(1)
    taps = [jnp.asarray(generator.normal(size=(1, 6, 4, c)), jnp.float32) for c in config.dpt_channels]

    def predicted():
        return jax.jit(lambda params, taps: predict_dense(params, taps, config, (2, 2), "depth"))(params, taps)

    whole = predicted()
    monkeypatch.setattr(dpt_head, "PIXELS_AT_ONCE", 4 * 28 * 28)  # four frames fit, three divide the six
    for made, expected in zip(predicted(), whole, strict=True):
        assert np.abs(made / expected - 1).max() < 1e-5
