"""Every way to the same numbers, against the public PyTorch code: attention of each platform, pieces, padded clips."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.parity.test_golden_forward import assert_close
from tests.shared.golden import BFLOAT16, GoldenPass, spread_error
from vggtjax import forward
from vggtjax.config import Suppress
from vggtjax.network.kernels import attention, cpu_attention, gathered_attention, pieces

IMPLEMENTATIONS = {
    "in chunks": cpu_attention.attention_in_chunks,
    "at once": attention._at_once,
    "packed": partial(attention._packed, implementation="xla"),
}


@pytest.fixture(scope="module")
def case():
    return GoldenPass("frames4")


@pytest.fixture(params=IMPLEMENTATIONS)
def implementation(request, monkeypatch):
    monkeypatch.setattr(gathered_attention, "attention", IMPLEMENTATIONS[request.param])
    monkeypatch.setattr(cpu_attention, "QUERIES_AT_ONCE", 60)
    monkeypatch.setattr(cpu_attention, "LOGITS_OF_ALL_HEADS", 0)
    return request.param


def masked_pass(case, images=None, tokens=None, suppress: Suppress = "drop", **options):
    """Return a masked pass, which takes every path of a plain one, too; a new jit traces what is patched."""
    images = case.images if images is None else images
    tokens = case.tokens if tokens is None else tokens
    masked = partial(forward, config=case.config, suppress=suppress, **options)
    return jax.jit(lambda p, x, t: masked(p, x, dynamic_tokens=t))(case.params, images, tokens)


def assert_golden(case, made, suppress="drop", frames=slice(None)):
    for value, key in ((made.pose_encoding, "pose_enc"), (made.depth, "depth"), (made.depth_confidence, "depth_conf")):
        if value is not None:
            assert_close(value[:, frames], case.arrays[f"{suppress}/{key}"])


@pytest.mark.proof
def test_attention_of_each_platform(case, implementation):
    assert_golden(case, masked_pass(case, outputs=("camera",)))


@pytest.mark.proof
def test_pieces(case, monkeypatch):
    monkeypatch.setattr(pieces, "NUMBERS_ON_CPU", 64 * case.config.embed_dim)
    assert_golden(case, masked_pass(case))


def test_padded_clips(case):
    rest = ((0, 0), (0, 3))
    images = np.pad(case.images, (*rest, *((0, 0),) * 3), mode="edge")
    tokens = np.pad(case.tokens, (*rest, (0, 0), (0, 0)), mode="edge")
    count = jnp.full(len(images), case.images.shape[1])
    made = masked_pass(case, images, tokens, "zero", frame_count=count)
    assert_golden(case, made, "zero", slice(case.images.shape[1]))


@pytest.mark.parametrize("name", ["plain", pytest.param("drop", marks=pytest.mark.proof)])
def test_bfloat16_stays_within_its_bound(case, name):
    run = jax.jit(
        lambda p, x, t: forward(p, x, case.config, dynamic_tokens=t, suppress="drop", compute_dtype="bfloat16")
    )
    made = run(case.params, case.images, None if name == "plain" else case.tokens)
    for value, key in ((made.pose_encoding, "pose_enc"), (made.depth, "depth"), (made.depth_confidence, "depth_conf")):
        error = spread_error(value, case.arrays[f"{name}/{key}"])
        assert error <= BFLOAT16[key], (name, key, error)
