"""Sampled keys against softmaxes over Python lists of keys, and what sampling must leave as it is."""

from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.tiny import tiny_config
from vggtjax.config import Suppress
from vggtjax.method.cues import GramCues
from vggtjax.network.kernels.sampled import early_pairs, frames_alone, sampled_attention, sampled_tokens
from vggtjax.network.model import forward, init_params
from vggtjax.network.suppression import SuppressedKeys, suppressed_attention

S, GRID, SPECIAL, N, D = 4, (3, 5), 2, 2, 8
T = SPECIAL + GRID[0] * GRID[1]


@pytest.fixture(scope="module")
def tokens():
    """Queries, keys and values of two clips, which tokens are suppressed, and which are real: three of four frames."""
    generator = np.random.default_rng(0)
    q, k, v = (generator.normal(size=(2, S * T, N, D)).astype(np.float32) for _ in range(3))
    suppressed = generator.random((2, S, T)) < 0.4
    suppressed[:, :, :SPECIAL] = False
    real = np.repeat(np.arange(S)[None] < np.array([[3], [4]]), T, axis=1)
    return q, k, v, suppressed.reshape(2, -1), real


def hide(hidden, active, suppress):
    return SuppressedKeys(jnp.asarray(hidden), jnp.asarray(active), suppress)


def reference(q, k, v, suppressed, real, suppress, early):
    """One clip; each query has a list of the keys that it sees."""
    out = np.zeros_like(q)
    for token in np.flatnonzero(real):
        frame = range(token // T * T, (token // T + 1) * T)
        seen = [other for other in (frame if early else sampled_tokens(S, GRID, SPECIAL)) if real[other]]
        if suppress == "drop":
            seen = [other for other in seen if not suppressed[other]]
        keys = np.array([np.zeros_like(k[other]) if suppressed[other] else k[other] for other in seen])
        logits = np.einsum("nd,knd->nk", q[token], keys) / D**0.5
        weights = np.exp(logits)
        out[token] = np.einsum("nk,knd->nd", weights / weights.sum(1, keepdims=True), v[seen])
    return out


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("suppress", [None, *get_args(Suppress), "shares"])
def test_equals_lists_of_keys(tokens, suppress, early):
    """Shares of 0 and 1 are those of "zero"."""
    q, k, v, suppressed, real = tokens
    if suppress == "shares":
        keys = hide(suppressed.astype(np.float32), 1.0, "zero")
    else:
        keys = None if suppress is None else hide(suppressed, True, suppress)
    sampled = sampled_attention(S, GRID, SPECIAL)
    run = jax.jit(lambda q, k, v, early: frames_alone(S, sampled, early)(q, k, v, keys, real))
    out = np.asarray(run(q, k, v, jnp.asarray(early)))
    for clip in range(2):
        hidden = suppressed[clip] if suppress else np.zeros_like(suppressed[clip])
        expected = reference(q[clip], k[clip], v[clip], hidden, real[clip], suppress, early)
        assert np.abs(out[clip] - expected)[real[clip]].max() < 2e-6


@pytest.mark.parametrize(("suppress", "active"), [(None, True), ("zero", True), ("drop", True), ("drop", False)])
def test_sampling_all_keys_is_exact(tokens, suppress, active):
    q, k, v, suppressed, real = tokens
    keys = None if suppress is None else hide(suppressed, active, suppress)
    sampled = sampled_attention(S, GRID, SPECIAL, square=1)
    out, expected = (np.asarray(attend(q, k, v, keys, real)) for attend in (sampled, suppressed_attention))
    assert np.abs(out - expected)[real].max() < 2e-6


def test_an_unknown_way_to_suppress_is_an_error(tokens):
    q, k, v, suppressed, real = tokens
    for attend in (sampled_attention(S, GRID, SPECIAL), suppressed_attention):
        with pytest.raises(KeyError, match="forget"):
            attend(q, k, v, hide(suppressed, True, "forget"), real)


def test_the_tokens_that_are_sampled():
    kept = np.zeros(5 * 40, bool)
    kept[sampled_tokens(5, (5, 7), 5, stride=None)] = True
    frames = kept.reshape(5, 40)
    assert frames[0].all()
    assert frames[:, :5].all()
    patches = frames[1:, 5:].reshape(4, 5, 7)
    assert (patches.sum(0) == 1).all()  # another place in every frame
    assert (patches.reshape(4, -1).sum(1) >= 2 * 3).all()
    more = set(sampled_tokens(6, (5, 7), 5))
    assert set(sampled_tokens(5, (5, 7), 5)) == {token for token in more if token < 200}
    assert set(range(0, 240, 10)) <= more


def test_early_pairs_are_those_of_the_paper():
    assert np.array_equal(early_pairs(24), np.arange(24) < 9)
    assert early_pairs(12).sum() == 4


@pytest.fixture(scope="module")
def model():
    config = tiny_config()
    images = np.random.default_rng(1).random((1, 4, 56, 56, 3)).astype(np.float32)
    return config, init_params(0, config), images


def test_what_is_exact_stays_exact(model):
    """The first pair's cues are those of exact attention."""
    config, params, images = model
    cues = GramCues(config.motion, config.depth)
    run = jax.jit(partial(forward, config=config, outputs=("camera",), cues=cues), static_argnames="attention")
    exact, sampled = (run(params, images, attention=name) for name in ("exact", "sampled"))
    for name, a, b in zip((cue.name for cue in config.motion.cues), exact.cue_sums, sampled.cue_sums, strict=True):
        same = np.abs(np.asarray(a - b)).max() <= 1e-6 * np.abs(np.asarray(a)).max()
        assert same == name.startswith("shallow"), name
    assert np.abs(np.asarray(exact.pose_encoding - sampled.pose_encoding)).max() > 1e-4


def test_a_padded_frame_changes_nothing(model):
    config, params, images = model
    run = jax.jit(partial(forward, config=config, outputs=("depth",), attention="sampled"))
    padded = np.concatenate([images, np.full_like(images[:, :2], np.nan)], axis=1)
    alone, among = run(params, images).depth, run(params, padded, frame_count=jnp.array([4])).depth
    assert np.abs(np.asarray(alone) - np.asarray(among)[:, :4]).max() < 1e-4 * np.abs(np.asarray(alone)).max()
