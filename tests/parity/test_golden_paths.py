"""Every way to the same numbers, against the public PyTorch code: attention of each platform, pieces, padded clips."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from testing.golden import BFLOAT16, GoldenPass, spread_error
from tests.parity.test_golden_forward import assert_close
from vggtjax import forward
from vggtjax.config import Suppress
from vggtjax.network import attention, gathered_attention, pieces

IMPLEMENTATIONS = {
    "in chunks": attention._in_chunks,
    "at once": attention._at_once,
    "packed": partial(attention._packed, implementation="xla"),
}


@pytest.fixture(scope="module")
def case():
    return GoldenPass("frames4")


@pytest.fixture(params=IMPLEMENTATIONS)
def implementation(request, monkeypatch):
    monkeypatch.setattr(gathered_attention, "attention", IMPLEMENTATIONS[request.param])
    monkeypatch.setattr(attention, "QUERIES_AT_ONCE", 60)
    monkeypatch.setattr(attention, "LOGITS_AT_ONCE", 0)
    return request.param


SUPPRESSIONS: tuple[Suppress, ...] = ("drop", "zero")


def passes(case, images=None, tokens=None, **options):
    """The plain pass and both masked ones, by the golden's names; a new jit, so that what is patched is traced."""
    images = case.images if images is None else images
    tokens = case.tokens if tokens is None else tokens
    yield "plain", jax.jit(lambda p, x: forward(p, x, case.config, **options))(case.params, images)
    for suppress in SUPPRESSIONS:
        masked = partial(forward, config=case.config, suppress=suppress, **options)
        run = jax.jit(lambda p, x, t, masked=masked: masked(p, x, dynamic_tokens=t))
        yield suppress, run(case.params, images, tokens)


def assert_golden(case, name, made, frames=slice(None)):
    for value, key in ((made.pose_encoding, "pose_enc"), (made.depth, "depth"), (made.depth_confidence, "depth_conf")):
        assert_close(value[:, frames], case.arrays[f"{name}/{key}"])


def test_attention_of_each_platform(case, implementation):
    for name, made in passes(case):
        assert_golden(case, name, made)


def test_pieces(case, monkeypatch):
    monkeypatch.setattr(pieces, "NUMBERS_ON_CPU", 64 * case.config.embed_dim)
    for name, made in passes(case):
        assert_golden(case, name, made)


def test_padded_clips(case):
    rest = ((0, 0), (0, 3))
    images = np.pad(case.images, (*rest, *((0, 0),) * 3), mode="edge")
    tokens = np.pad(case.tokens, (*rest, (0, 0), (0, 0)), mode="edge")
    for name, made in passes(case, images, tokens, frame_count=jnp.full(len(images), case.images.shape[1])):
        assert_golden(case, name, made, slice(case.images.shape[1]))


def test_bfloat16_stays_within_its_bound(case):
    for name, made in passes(case, compute_dtype="bfloat16"):
        for value, key in (
            (made.pose_encoding, "pose_enc"),
            (made.depth, "depth"),
            (made.depth_confidence, "depth_conf"),
        ):
            error = spread_error(value, case.arrays[f"{name}/{key}"])
            assert error <= BFLOAT16[key], (name, key, error)
