"""The scan with its cond against the unrolled reference, and what suppression must and must not change."""

from functools import partial

import jax
import numpy as np
import pytest

from tests.shared import reference
from tests.shared.aggregation import aggregate
from vggtjax import VGGTConfig
from vggtjax.config import Suppress
from vggtjax.network.aggregator import identity
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


@partial(jax.jit, static_argnames=("suppress", "mask_pairs"))
def run(params, tokens, dynamic=None, suppress: Suppress = "zero", mask_pairs=5):
    suppression = Suppression(dynamic, suppress, mask_pairs)
    return aggregate(params, tokens, CONFIG, GRID, captures=[identity] * 4, suppression=suppression)


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


@pytest.mark.parametrize("suppress", ["zero", "drop"])
def test_suppressing_nothing_is_the_plain_pass(small, suppress):
    params, tokens, mask = small
    _, plain, _ = run(params, tokens)
    for how in [(np.zeros_like(mask), suppress), (mask, suppress, 0)]:
        for a, b in zip(run(params, tokens, *how)[1], plain, strict=True):
            assert np.abs(np.asarray(a - b)).max() <= 1e-5


def test_only_captures_are_kept(small):
    params, tokens, _ = small
    captures = [lambda t: {"camera": t[:, :, 0]}, lambda t: (), identity, identity]
    _, kept, _ = jax.jit(partial(aggregate, config=CONFIG, grid=GRID, captures=captures))(params, tokens)
    _, whole, _ = run(params, tokens)
    assert kept[1] == ()
    assert np.allclose(kept[0]["camera"], whole[0][:, :, 0], atol=1e-5)
