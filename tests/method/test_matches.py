"""Dense matches against every attention matrix, and the pairs of frames that are matched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from vggtjax.method.matching.matches import DenseMatches, frame_pairs
from vggtjax.network.kernels.frames import BY_FRAME, Frames

S, GRID, SPECIAL, DEPTH, LAYERS = 10, (3, 4), 2, 4, (1, 2)
PATCHES = GRID[0] * GRID[1]


def slow_matches(q, k):
    """Return position, confidence and maximum of the match of patch p of frame s in frame t, [S, S, P], in one pair."""
    centres = np.array([(x + 0.5, y + 0.5) for y in range(GRID[0]) for x in range(GRID[1])])
    position, confidence, best = np.zeros((S, S, PATCHES, 2)), np.zeros((S, S, PATCHES)), np.zeros((S, S, PATCHES), int)
    for s, t, p in np.ndindex(S, S, PATCHES):
        logits = np.mean([k[t, :, n] @ q[s, p, n] / q.shape[-1] ** 0.5 for n in range(q.shape[2])], axis=0)
        attention = np.exp(logits - logits.max())
        attention /= attention.sum()
        best[s, t, p] = attention.argmax()
        near = np.abs(centres - centres[best[s, t, p]]).max(axis=1) <= 1
        confidence[s, t, p] = attention[near].sum()
        position[s, t, p] = attention[near] @ centres[near] / confidence[s, t, p]
    return position, confidence, best, centres


@pytest.mark.parametrize("padding", ["none", "by count", "on a device"])
def test_a_match_is_that_of_the_better_pair_of_blocks(padding):
    q, k = np.random.default_rng(0).normal(size=(2, DEPTH, S + 2, SPECIAL + PATCHES, 2, 4)).astype(np.float32) * 2
    mesh = Mesh(np.array(jax.devices()[:1]), ("frames",))
    matches = DenseMatches(LAYERS, DEPTH, GRID, Frames(mesh, S) if padding == "on a device" else Frames())
    given = S if padding == "none" else S + 2
    count = jnp.array([S]) if padding == "by count" else None

    def all_pairs(q, k):
        def add(sums, layer):
            counts, q, k = layer
            return matches.add(sums, counts, q, k, count), None

        layers = (jnp.asarray(matches.layer_counts()), *(jnp.moveaxis(x, 2, 0) for x in (q, k)))
        return jax.lax.scan(add, matches.frames.varying(matches.zeros(1, q.shape[1], PATCHES)), layers)[0]

    on_devices = matches.frames.on_devices(all_pairs, BY_FRAME, BY_FRAME)
    found = jax.jit(on_devices)(*(jnp.asarray(x[:, :given].swapaxes(0, 1)[None]) for x in (q, k)))
    pairs, in_pair = frame_pairs(S), []
    for layer in LAYERS:
        position, confidence, best, centres = slow_matches(q[layer, :S, SPECIAL:], k[layer, :S, SPECIAL:])
        back = position.swapaxes(0, 1)[np.arange(S)[:, None, None], np.arange(S)[None, :, None], best]
        cycle = np.linalg.norm(back - centres, axis=-1)
        in_pair.append((position, confidence, cycle, confidence * np.exp(-((cycle / 0.75) ** 2))))
    better = in_pair[1][3] >= in_pair[0][3]
    for m, offset in enumerate(pairs.offsets):
        for s in range(S):
            if not 0 <= s + offset < S:
                assert not found.confidence[0, s, m].any()
                continue
            for own, of_pair in zip(found, zip(*in_pair, strict=True), strict=False):
                chosen = better[s, s + offset].reshape(-1, *(1,) * (own.ndim - 4))
                expected = np.where(chosen, of_pair[1][s, s + offset], of_pair[0][s, s + offset])
                assert np.allclose(own[0, s, m], expected, atol=1e-4)


def test_the_gradient_by_queries_agrees_with_differences():
    """Of the matches' positions and confidences; the maximum does not change for small steps."""
    matches, frames = DenseMatches(LAYERS, DEPTH, GRID), 4
    q, k, towards = np.random.default_rng(3).normal(size=(3, 1, frames, PATCHES, 2, 4))

    def total(step):
        found = matches.add(matches.zeros(1, frames, PATCHES), jnp.ones(1, int), q + step * towards, k)
        return jnp.sum(found.position * jnp.arange(1.0, 3)[None, None, None, None]) + jnp.sum(found.confidence**2)

    with jax.enable_x64(True):
        slope, function = jax.jit(jax.grad(total))(0.0), jax.jit(total)
        assert np.allclose(slope, (function(1e-6) - function(-1e-6)) / 2e-6, rtol=1e-5)


def test_frames_are_matched_with_near_ones_both_ways():
    assert frame_pairs(2).offsets == (-1, 1)
    assert frame_pairs(1).others.shape == (1, 0)
    offsets, others, exist = frame_pairs(4)
    assert offsets == (-1, 1, -2, 2, -3, 3)
    assert exist[0].tolist() == [False, True] * 3
    assert others[3].tolist() == [2, 3, 1, 3, 0, 3]
    assert len(frame_pairs(500).offsets) == len(frame_pairs(9).offsets)  # the cost is linear in frames
