"""The track head: golden numbers of the public code are in parity/; here chunks, edges, gradients and bad input."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax import forward
from vggtjax.errors import InputError
from vggtjax.network import track_head
from vggtjax.network.dpt_head import project_tap
from vggtjax.network.model import init_params
from vggtjax.network.track_head import VIRTUAL_TRACKS, Tracks, predict_tracks


def sampled(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Bilinear value of an image [H, W, F] at x, y, as slowly as possible; 0 outside."""
    total = np.zeros(image.shape[2])
    H, W = image.shape[:2]
    for j in (int(np.floor(y)), int(np.floor(y)) + 1):
        for i in (int(np.floor(x)), int(np.floor(x)) + 1):
            if 0 <= j < H and 0 <= i < W:
                total += image[j, i] * (1 - abs(x - i)) * (1 - abs(y - j))
    return total


def test_correlations_against_samples_written_out(config, monkeypatch):
    generator = np.random.default_rng(0)
    S, Q, F, r = 2, 7, config.track_features, config.track_corr_radius
    size = (37, 18)  # down to 2 x 1: an axis of one pixel
    maps = generator.normal(size=(S, *size, F)).astype(np.float32)
    features = generator.normal(size=(S, Q, F)).astype(np.float32)
    positions = (generator.uniform(-0.3, 1.3, size=(S, Q, 2)) * [size[1], size[0]]).astype(np.float32)
    positions[0, 0], positions[1, 1] = (1e7, -1e7), (3.0, 5.0)
    levels, level = [], maps
    for _ in range(config.track_corr_levels):
        levels.append(level)
        h, w = level.shape[1] // 2, level.shape[2] // 2
        level = level[:, : 2 * h, : 2 * w].reshape(S, h, 2, w, 2, F).mean(axis=(2, 4))
    expected = np.zeros((S, Q, len(levels), 2 * r + 1, 2 * r + 1))
    for s, q, k in np.ndindex(S, Q, len(levels)):
        image = levels[k][s]
        for i, j in np.ndindex(2 * r + 1, 2 * r + 1):
            x, y = positions[s, q] / 2.0**k + [i - r, j - r]
            x, y = (0 if side == 1 else at for side, at in ((image.shape[1], x), (image.shape[0], y)))
            if abs(x) < 1000 and abs(y) < 1000:
                expected[s, q, k, i, j] = sampled(image, x, y) @ features[s, q] / F**0.5
    run: Any = jax.jit(track_head._correlations, static_argnums=(3, 4))
    for floats in (1 << 24, 3 * S * (2 * r + 2) ** 2 * F):  # all at once; three queries at a time, of seven
        monkeypatch.setattr(track_head, "FLOATS_AT_ONCE", floats)
        run.clear_cache()
        pyramid = track_head._pyramid(jnp.asarray(maps)[None], config.track_corr_levels, r)
        with jax.default_matmul_precision("highest"):
            made = run([p[0] for p in pyramid], features, positions, size, config)
        assert np.abs(np.asarray(made).reshape(expected.shape) - expected).max() < 1e-4


@pytest.fixture(scope="module")
def head(config):
    """Parameters of a track head and taps of two clips of three frames, 6 x 5 patches."""
    params = init_params(1, config)["track_head"]
    generator = np.random.default_rng(2)
    tokens = jnp.asarray(generator.normal(size=(2, 3, 30, config.tap_dim)), jnp.float32)
    return params, [project_tap(params, tokens, slot, config) for slot in range(4)]


def run(head, config, queries) -> Tracks:
    params, taps = head
    return jax.jit(predict_tracks, static_argnums=(3, 4))(params, taps, jnp.asarray(queries), config, (6, 5))


QUERIES = np.array([[[3.0, 4.0], [60.5, 70.25], [0.0, 83.0]], [[10.0, 10.0], [69.0, 0.0], [33.0, 33.0]]], np.float32)


def test_the_first_frame_keeps_the_queries(head, config):
    made = run(head, config, QUERIES)
    assert made.positions.shape == (2, 3, 3, 2)
    assert np.array_equal(made.positions[:, 0], QUERIES)
    for scores in made[1:]:
        assert scores.shape == (2, 3, 3)
        assert 0 <= float(scores.min()) <= float(scores.max()) <= 1


def test_the_order_of_queries_and_clips_does_not_matter(head, config):
    made = run(head, config, QUERIES)
    swapped = run((head[0], [tap[::-1] for tap in head[1]]), config, QUERIES[::-1, ::-1])
    for one, other in zip(made, swapped, strict=True):
        assert np.abs(one - other[::-1, :, ::-1]).max() < 1e-3


def test_later_frames_can_be_permuted(head, config):
    made = run(head, config, QUERIES)
    order = np.array([0, 2, 1])
    swapped = run((head[0], [tap[:, order] for tap in head[1]]), config, QUERIES)
    assert np.abs(made.positions[:, order] - swapped.positions).max() < 1e-3


@pytest.mark.proof
def test_gradients_reach_parameters_and_taps(head, config):
    def loss(params, taps):
        tracks = predict_tracks(params, taps, jnp.asarray(QUERIES), config, (6, 5))
        return sum(leaf.sum() for leaf in tracks)

    by_params, by_taps = jax.jit(jax.grad(loss, argnums=(0, 1)))(*head)
    for gradient in jax.tree.leaves((by_params, by_taps)):
        assert np.isfinite(gradient).all()
    assert float(jnp.abs(by_params["virtual_tracks"]).max()) > 0
    assert float(jnp.abs(by_taps[3]).max()) > 0
    assert by_params["virtual_tracks"].shape[0] == VIRTUAL_TRACKS


@pytest.mark.parametrize(
    ("outputs", "queries", "said"),
    [
        (("camera",), np.zeros((1, 3, 2)), "go together"),
        (("tracks",), np.zeros((2, 3, 2)), "have shape"),
        (("tracks",), np.zeros((1, 0, 2)), "with at least one point"),
        (("tracks",), np.zeros((1, 3, 2)), "at least 32 pixels"),
    ],
)
def test_bad_queries(params, config, outputs, queries, said):
    with pytest.raises(InputError, match=said):
        forward(params, jnp.zeros((1, 2, 14, 28, 3)), config, outputs=outputs, query_points=queries)
