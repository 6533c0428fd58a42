"""The track head: golden numbers of the public code are in parity/; here chunks, edges, gradients and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax import forward
from vggtjax.errors import InputError
from vggtjax.network.heads import track_head
from vggtjax.network.heads.dpt_head import project_tap
from vggtjax.network.heads.track_head import VIRTUAL_TRACKS, Tracks, predict_tracks
from vggtjax.network.model import init_params


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
        assert 0 <= float(scores.min()) <= float(scores.max()) <= 1


def test_the_order_of_queries_and_clips_does_not_matter(head, config):
    made = run(head, config, QUERIES)
    swapped = run((head[0], [tap[::-1] for tap in head[1]]), config, QUERIES[::-1, ::-1])
    for one, other in zip(made, swapped, strict=True):
        assert np.abs(one - other[::-1, :, ::-1]).max() < 1e-3


def test_queries_whose_correlations_are_taken_in_turns_have_the_same_numbers(head, config, monkeypatch):
    window = 2 * config.track_corr_radius + 2
    monkeypatch.setattr(track_head, "FLOATS_AT_ONCE", 2 * 3 * window**2 * config.track_features)  # two, then one
    params, taps = head
    traced = jax.jit(lambda params, taps, queries: predict_tracks(params, taps, queries, config, (6, 5)))
    in_turns = traced(params, taps, jnp.asarray(QUERIES))
    for one, other in zip(run(head, config, QUERIES), in_turns, strict=True):
        assert np.abs(one - other).max() < 1e-3


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
