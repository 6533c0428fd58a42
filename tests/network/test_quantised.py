"""Kernels in 8 bits: the rounding by hand, what a model keeps of its predictions, and how it is loaded."""

import numpy as np
import pytest

from vggtjax import load_model
from vggtjax.clips.clip import load_clip
from vggtjax.errors import CheckpointError
from vggtjax.network.checkpoint import save_model
from vggtjax.network.kernels.quantised import Quantised, as_multiplied, quantise
from vggtjax.pipeline.run import reconstruct


def test_the_rounding_by_hand():
    kernel = np.array([[[1.0, 0.0, -0.5], [-2.54, 0.0, 0.26]]], np.float32)  # a layer, two inputs, three outputs
    values, scale = quantise(kernel)
    assert np.asarray(values).tolist() == [[[50, 0, -127], [-127, 0, 66]]]
    assert np.allclose(scale, [[[0.02, 1, 0.5 / 127]]])
    back = as_multiplied({"kernel": Quantised(values, scale), "bias": kernel})
    assert np.abs(np.asarray(back["kernel"]) - kernel).max() <= np.asarray(scale).max() / 2
    assert back["bias"] is kernel


@pytest.fixture(scope="module")
def models():
    return load_model("demo"), load_model("demo", dtype="int8")


def test_a_model_is_smaller_and_nearly_the_same(models):
    exact, rounded = models
    assert rounded.dtype == "int8"
    assert rounded.parameter_count == exact.parameter_count
    assert rounded.parameter_bytes < 0.4 * exact.parameter_bytes
    assert rounded.identity != exact.identity
    clip = load_clip(np.random.default_rng(0).random((2, 64, 64, 3), np.float32), size=64, patch=8)
    depths = [reconstruct(model, clip, method="vggt").depth for model in (rounded, exact)]
    assert 0 < np.abs(depths[0] / depths[1] - 1).mean() < 0.01


def test_what_cannot_be_done_is_one_sentence(models, tmp_path):
    rounded = models[1]
    with pytest.raises(CheckpointError, match="int8; expected float32 or bfloat16"):
        save_model(tmp_path / "model.safetensors", rounded.params, rounded.config)
