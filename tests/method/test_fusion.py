"""Region-aware depth: hand-computed values, limits, scale alignment."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vggtjax import fuse_depth
from vggtjax.method.fusion.rule import replace_depth, scale_between

D1, C1 = jnp.asarray([[[2.0, 2.0, 2.0]]]), jnp.asarray([[[1.0, 1.0, 3.0]]])
D2, C2 = jnp.asarray([[[4.0, 4.0, 4.0]]]), jnp.asarray([[[3.0, 3.0, 1.0]]])
DYNAMIC = jnp.asarray([[[False, True, False]]])


def test_fusion_by_hand():
    depth, confidence = fuse_depth(D1, C1, D2, C2, DYNAMIC)
    assert np.allclose(depth, [[[3.5, 2.0, 2.5]]], atol=1e-5)
    assert np.allclose(confidence, [[[4.0, 1.0, 4.0]]])
    # Without any confidence the weight of the second pass is 0; with eps = 1 it is 3 / (1 + 3 + 1).
    assert np.allclose(fuse_depth(D1, 0 * C1, D2, 0 * C2, DYNAMIC)[0], D1)
    assert np.allclose(fuse_depth(D1, C1, D2, C2, DYNAMIC, eps=1.0)[0], [[[3.2, 2.0, 2.4]]])


def test_hard_replacement_by_hand():
    depth, confidence = replace_depth(D1, C1, D2, C2, DYNAMIC)
    assert np.asarray(depth).tolist() == [[[4.0, 2.0, 4.0]]]
    assert np.asarray(confidence).tolist() == [[[3.0, 1.0, 1.0]]]


_maps = hnp.arrays(np.float32, (2, 3, 4), elements=st.floats(1, 100, width=32))


@settings(max_examples=50)
@given(_maps, _maps, _maps, _maps, hnp.arrays(bool, (2, 3, 4)))
def test_fusion_equals_the_formula_and_stays_between_the_passes(d1, c1, d2, c2, dynamic):
    depth, confidence = fuse_depth(d1, c1, d2, c2, dynamic)
    w = c2.astype(np.float64) / (c1.astype(np.float64) + c2 + 1e-6)
    assert np.allclose(depth, np.where(dynamic, d1, (1 - w) * d1 + w * d2), rtol=1e-6)
    assert np.allclose(confidence, np.where(dynamic, c1, c1 + c2), rtol=1e-6)
    assert (depth >= np.minimum(d1, d2) * (1 - 1e-5)).all()
    assert (depth <= np.maximum(d1, d2) * (1 + 1e-5)).all()


def test_any_number_of_leading_axes():
    d1, c1, d2, c2 = (
        jnp.asarray(np.random.default_rng(i).uniform(1, 2, (2, 3, 4, 5)).astype(np.float32)) for i in range(4)
    )
    maps = (d1, c1, d2, c2, d1 > 1.5)
    batch, _ = fuse_depth(*maps)
    for b in range(2):
        assert np.allclose(batch[b], jax.vmap(fuse_depth)(*maps)[0][b])
        assert np.allclose(batch[b, 0], fuse_depth(d1[b, 0], c1[b, 0], d2[b, 0], c2[b, 0], maps[4][b, 0])[0])


def test_scale_is_the_median_ratio_over_static_pixels():
    d2 = jnp.asarray([[[[1.0, 2.0, 4.0, 1.0]]]])
    d1 = jnp.asarray([[[[3.0, 6.0, 12.0, 100.0]]]])
    dynamic = jnp.asarray([[[[False, False, False, True]]]])
    assert np.asarray(scale_between(d1, d2, dynamic)).tolist() == [3.0]
    assert np.asarray(scale_between(d1, d2, jnp.ones_like(dynamic))).tolist() == [1.0]


def test_overflowing_confidence_stays_finite():
    one = jnp.ones((1, 1, 2))
    for c1, c2 in ((jnp.inf, 1.0), (1.0, jnp.inf), (jnp.inf, jnp.inf), (1e30, 1e30)):
        depth, confidence = fuse_depth(one, c1 * one, 3 * one, c2 * one, jnp.zeros((1, 1, 2), bool))
        assert np.isfinite(depth).all()
        assert np.isfinite(confidence).all()
