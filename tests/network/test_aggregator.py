"""The scan with its cond against the unrolled reference, and what suppression must and must not change."""

from functools import partial

import jax
import numpy as np
import pytest

from tests import reference
from vggtjax import VGGTConfig
from vggtjax.config import Suppress
from vggtjax.method.cues import GramCues
from vggtjax.network.aggregator import aggregate, identity
from vggtjax.network.model import parameter_shapes
from vggtjax.network.suppression import Suppression

GRID = (2, 3)
CONFIG = VGGTConfig(
    image_size=28, embed_dim=16, depth=7, num_heads=2, dino_depth=1, dino_num_heads=2, camera_depth=1,
    camera_num_heads=2, dpt_features=8, dpt_channels=(8, 8, 8, 8), taps=(1, 3, 4, 6), track_features=8, track_hidden=16,
    track_corr_levels=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def small():
    """A small model with weights of order one, and the patch tokens of a batch of two clips of three frames."""
    generator = np.random.default_rng(0)

    def leaf(path, shape):
        name = path[-1].key
        centre = {"scale": 1.0, "scale1": 0.5, "scale2": 0.5}.get(name, 0.0)
        return (centre + 0.3 * generator.normal(size=shape.shape)).astype(np.float32)

    params = {"aggregator": jax.tree_util.tree_map_with_path(leaf, parameter_shapes(CONFIG)["aggregator"])}
    tokens = generator.normal(size=(2, 3, 6, 16)).astype(np.float32)
    mask = generator.random((2, 3, *GRID)) < 0.4
    return params, tokens, mask


@partial(jax.jit, static_argnames=("suppress", "mask_pairs", "with_cues"))
def run(params, tokens, dynamic=None, suppress: Suppress = "zero", mask_pairs=5, with_cues=False):
    return aggregate(
        params, tokens, CONFIG, GRID, captures=[identity] * 4, suppression=Suppression(dynamic, suppress, mask_pairs),
        accumulator=GramCues(CONFIG.motion, CONFIG.depth) if with_cues else None,
    )  # fmt: skip


@pytest.mark.parametrize("suppress", [None, "zero", "drop"])
def test_scan_equals_unrolled_reference(small, suppress):
    params, tokens, mask = small
    dynamic = None if suppress is None else mask
    _, made, _ = run(params, tokens, dynamic, suppress or "zero", mask_pairs=3)
    for b in range(2):
        taps, _, _ = reference.aggregate(
            params, tokens[b], CONFIG, GRID, None if dynamic is None else dynamic[b], suppress or "zero", mask_pairs=3
        )
        for tap, expected in zip(made, taps, strict=True):
            assert np.abs(np.asarray(tap[b]) - expected).max() <= 2e-5 * expected.std()


def test_suppression_does_something(small):
    params, tokens, mask = small
    plain, zero, drop = (run(params, tokens, *how)[1][-1] for how in [(), (mask, "zero"), (mask, "drop")])
    for a, b in [(plain, zero), (plain, drop), (zero, drop)]:
        assert np.abs(np.asarray(a - b)).max() > 1e-2


@pytest.mark.parametrize("suppress", ["zero", "drop"])
def test_suppressing_nothing_is_the_plain_pass(small, suppress):
    params, tokens, mask = small
    _, plain, _ = run(params, tokens)
    for how in [(np.zeros_like(mask), suppress), (mask, suppress, 0)]:
        for a, b in zip(run(params, tokens, *how)[1], plain, strict=True):
            assert np.abs(np.asarray(a - b)).max() <= 1e-5


@pytest.mark.parametrize("suppress", ["zero", "drop"])
def test_suppressing_everything_is_finite(small, suppress):
    params, tokens, mask = small
    _, taps, _ = run(params, tokens, np.ones_like(mask), suppress)
    assert all(np.isfinite(tap).all() for tap in taps)


def test_only_captures_are_kept(small):
    params, tokens, _ = small
    _, kept, _ = aggregate(
        params, tokens, CONFIG, GRID, captures=[lambda t: {"camera": t[:, :, 0]}, lambda t: (), identity, identity]
    )
    _, whole, _ = run(params, tokens)
    assert kept[1] == ()
    assert np.allclose(kept[0]["camera"], whole[0][:, :, 0], atol=1e-5)


@pytest.mark.parametrize("gram", ["cosine", "dot"])
def test_linear_cost_cues_equal_the_gram_matrices(small, gram):
    params, tokens, _ = small
    cues = GramCues(CONFIG.motion, CONFIG.depth, gram)
    _, _, sums = jax.jit(partial(aggregate, config=CONFIG, grid=GRID, captures=[identity] * 4, accumulator=cues))(
        params, tokens
    )
    maps = cues.maps(sums)
    for b in range(2):
        _, q, k = reference.aggregate(params, tokens[b], CONFIG, GRID)
        product = np.ones((3, 6))
        for cue in CONFIG.motion.cues:
            rows, columns = ({"q": q, "k": k}[name] for name in (cue.rows, cue.columns))
            layers = CONFIG.motion.layers(cue, CONFIG.depth)
            expected = reference.gram_map(rows, columns, layers, cue.statistic, CONFIG.motion.offsets, gram)
            assert np.abs(np.asarray(maps[cue.name][b]) - expected).max() <= 2e-5, cue.name
            product *= 1 - expected if cue.inverted else expected
        low, high = product.min(1, keepdims=True), product.max(1, keepdims=True)
        saliency = np.asarray(cues.saliency(sums)[b])
        assert np.abs(saliency - (product - low) / (high - low + 1e-6)).max() <= 1e-4


def test_anything_with_sums_can_be_accumulated(small):
    """The aggregator knows no motion cues: here the mean of q, over the pairs that are counted."""
    params, tokens, _ = small

    class Means:
        def layer_counts(self):
            return np.arange(CONFIG.depth) % 2

        def zeros(self, B, S, P):
            return {"mean": np.zeros((B, S, P))}

        def add(self, sums, counts, q, k, frame_count):
            return {"mean": sums["mean"] + counts * q[:, :, -sums["mean"].shape[2] :].mean(axis=(3, 4))}

    _, _, sums = aggregate(params, tokens, CONFIG, GRID, captures=[lambda t: ()] * 4, accumulator=Means())
    q = reference.aggregate(params, tokens[0], CONFIG, GRID)[1]
    expected = sum(x[:, -6:].mean(axis=(2, 3)) for x in q[1::2])
    assert np.abs(np.asarray(sums["mean"][0]) - expected).max() < 1e-5
