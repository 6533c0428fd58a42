"""Arrays of callers: of torch, of lists, with NaN; taken, or refused by one sentence at every public function."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from vggtjax import encode, infer
from vggtjax.errors import InputError
from vggtjax.method.algorithm import run_method, run_passes
from vggtjax.network.given import as_array
from vggtjax.network.model import forward
from vggtjax.options import Options

_VGGT = Options(method="vggt")


@pytest.fixture(name="calls")
def _calls(params, config):
    """Return each public function of a batch, as a function of the images."""
    return {
        "forward": lambda images: forward(params, images, config, outputs=("camera",)).pose_encoding,
        "encode": lambda images: encode(params, images, config),
        "run_passes": lambda images: run_passes(params, images, config, _VGGT).first.pose_encoding,
        "run_method": lambda images: run_method(params, images, config, _VGGT)[1].first.pose_encoding,
        "infer": lambda images: infer(params, images, config, options=_VGGT)[1].first.pose_encoding,
    }


@pytest.fixture(name="images", scope="module")
def _images():
    return np.random.default_rng(0).random((1, 2, 28, 28, 3), np.float32)


def test_a_batch_of_torch_or_of_lists_is_the_batch(calls, images):
    expected = calls["infer"](images)
    np.testing.assert_allclose(calls["infer"](torch.from_numpy(images)), expected, atol=1e-5)
    np.testing.assert_allclose(calls["forward"](images.tolist()), expected, atol=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("library", [np.asarray, jnp.asarray, torch.tensor])
def test_a_pixel_that_is_not_finite_is_named(calls, images, value, library):
    images = images.copy()
    images[0, 1, 3, 4, 2] = value
    for call in calls.values():
        with pytest.raises(InputError, match=r"1 values that are NaN or infinite, the first at \[0, 1, 3, 4, 2\]"):
            call(library(images))


def test_bytes_are_refused(calls, images):
    for call in calls.values():
        for dtype in (np.uint8, np.int32):
            with pytest.raises(InputError, match=rf"images have type {np.dtype(dtype)}; .*: divide bytes by 255"):
                call((255 * images).astype(dtype))


def test_images_that_a_jit_traces_are_not_looked_into(params, config, images):
    run = jax.jit(partial(forward, config=config, outputs=("camera",)))
    assert np.isnan(np.asarray(run(params, images * np.nan).pose_encoding)).any()


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (torch.ones(2, dtype=torch.bfloat16), r"numpy cannot read this torch.Tensor \(.*BFloat16"),
        (torch.ones(2, requires_grad=True), r"requires grad.*tensor\.detach\(\)"),
        ([[1.0], [1.0, 2.0]], "numpy cannot read this list"),
        ("picture.png", "numpy cannot read this str"),
        (np.array(["a.png", "b.png"]), "numpy cannot read this numpy.ndarray"),
    ],
)
def test_what_numpy_cannot_read_is_refused(value, sentence):
    with pytest.raises(InputError, match=f"images: .*{sentence}"):
        as_array("images", value)


def test_the_order_of_the_axes_is_said(calls, images):
    for call in calls.values():
        with pytest.raises(InputError, match=r"shape \(1, 2, 3, 28, 28\); .*np\.moveaxis\(images, 2, -1\)"):
            call(torch.from_numpy(images).permute(0, 1, 4, 2, 3))
        with pytest.raises(InputError, match=r"shape \(2, 28, 28, 3\); .* give images\[None\]"):
            call(images[0])
