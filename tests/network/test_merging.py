"""Token merging against groups formed one token at a time, and what it must leave as it is."""

from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tiny import tiny_config
from vggtjax.config import Suppress
from vggtjax.method.cues import GramCues
from vggtjax.network.merging import kept_tokens, merged_attention
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


def reference(q, k, v, suppressed, real, suppress):
    """One clip; every group is a Python list, and every suppressed key has a logit of its own."""
    kept = list(kept_tokens(S, GRID, SPECIAL))
    unit = k.reshape(len(k), -1) / np.linalg.norm(k.reshape(len(k), -1), axis=1, keepdims=True)
    group = {}
    for token in range(len(k)):
        choices = [other for other in kept if real[other]]
        group[token] = token if token in kept else max(choices, key=lambda other: unit[token] @ unit[other])
    keys, values, counts = [], [], []
    for centre in kept:
        members = [token for token in group if group[token] == centre and real[token] and not suppressed[token]]
        if members:
            keys.append(k[members].mean(0))
            values.append(v[members].mean(0))
            counts.append(len(members))
    for token in np.flatnonzero(suppressed & real) if suppress == "zero" else ():
        keys.append(np.zeros_like(k[0]))
        values.append(v[token])
        counts.append(1)
    out = np.zeros_like(q)
    for token in np.flatnonzero(real):
        members = [other for other in group if group[other] == group[token] and real[other]]
        logits = np.einsum("nd,knd->nk", q[members].mean(0), np.array(keys)) / D**0.5
        weights = np.exp(logits) * np.array(counts)[None]
        out[token] = np.einsum("nk,knd->nd", weights / weights.sum(1, keepdims=True), np.array(values))
    return out


@pytest.mark.parametrize("suppress", [None, *get_args(Suppress)])
def test_equals_groups_formed_one_by_one(tokens, suppress):
    q, k, v, suppressed, real = tokens
    keys = None if suppress is None else hide(suppressed, True, suppress)
    merged = merged_attention(S, GRID, SPECIAL)
    out = np.asarray(jax.jit(lambda q, k, v: merged(q, k, v, keys, real))(q, k, v))
    for clip in range(2):
        hidden = suppressed[clip] if suppress else np.zeros_like(suppressed[clip])
        expected = reference(q[clip], k[clip], v[clip], hidden, real[clip], suppress)
        assert np.abs(out[clip] - expected)[real[clip]].max() < 2e-5


@pytest.mark.parametrize(("suppress", "active"), [(None, True), ("zero", True), ("drop", True), ("drop", False)])
def test_keeping_all_tokens_is_exact(tokens, suppress, active):
    q, k, v, suppressed, real = tokens
    keys = None if suppress is None else hide(suppressed, active, suppress)
    merged = merged_attention(S, GRID, SPECIAL, region=1)
    both = jax.jit(lambda q, k, v: (merged(q, k, v, keys, real), suppressed_attention(q, k, v, keys, real)))
    out, expected = both(q, k, v)
    assert np.abs(np.asarray(out) - np.asarray(expected))[real].max() < 2e-6


def test_an_unknown_way_to_suppress_is_an_error(tokens):
    q, k, v, suppressed, real = tokens
    for attend in (merged_attention(S, GRID, SPECIAL), suppressed_attention):
        with pytest.raises(KeyError, match="forget"):
            attend(q, k, v, hide(suppressed, True, "forget"), real)


def test_the_tokens_that_are_kept():
    kept = np.zeros(5 * 40, bool)
    kept[kept_tokens(5, (5, 7), 5, stride=None)] = True
    frames = kept.reshape(5, 40)
    assert frames[0].all()
    assert frames[:, :5].all()
    patches = frames[1:, 5:].reshape(4, 5, 7)
    for top in range(0, 5, 2):
        for left in range(0, 7, 2):
            assert (patches[:, top : top + 2, left : left + 2].sum((1, 2)) == 1).all()
    assert len({frame.tobytes() for frame in patches}) == 4  # another place in every frame
    more = kept_tokens(6, (5, 7), 5)
    assert set(kept_tokens(5, (5, 7), 5)) == {token for token in more if token < 200}
    assert set(range(0, 240, 10)) <= set(more)


@pytest.fixture(scope="module")
def model():
    config = tiny_config()
    images = np.random.default_rng(1).random((1, 4, 56, 56, 3)).astype(np.float32)
    return config, init_params(0, config), images


def test_what_is_exact_stays_exact(model):
    """The first pair's cues and every frame's own attention are those of exact attention."""
    config, params, images = model
    cues = GramCues(config.motion, config.depth)
    run = jax.jit(partial(forward, config=config, outputs=("camera",), cues=cues), static_argnames="attention")
    exact, merged = (run(params, images, attention=name) for name in ("exact", "merged"))
    for name, a, b in zip((cue.name for cue in config.motion.cues), exact.cue_sums, merged.cue_sums, strict=True):
        same = np.abs(np.asarray(a - b)).max() <= 1e-6 * np.abs(np.asarray(a)).max()
        assert same == name.startswith("shallow"), name
    assert np.abs(np.asarray(exact.pose_encoding - merged.pose_encoding)).max() > 1e-4
