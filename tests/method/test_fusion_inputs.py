"""What rules of fusion see of two passes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from vggtjax.errors import InputError
from vggtjax.method.fusion.family import soft_mask
from vggtjax.method.fusion.inputs import REACH, edge_distance, edge_proximity, observe
from vggtjax.method.passes import Passes
from vggtjax.network.model import Predictions

_distance = jax.jit(edge_distance)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.0005, 0.01, 0.3, 0.9]))
def test_the_distance_is_exact(seed, share):
    mask = np.random.default_rng(seed).random((40, 90)) < share
    if mask.all() or not mask.any():
        assert np.isinf(_distance(mask)).all()
        return
    to_static, to_dynamic = np.asarray(distance_transform_edt(mask)), np.asarray(distance_transform_edt(~mask))
    wanted = np.where(mask, to_static, to_dynamic)
    found = np.asarray(_distance(mask))
    assert np.allclose(found[wanted <= REACH], wanted[wanted <= REACH], rtol=1e-6)
    assert np.isinf(found[wanted > REACH]).all()


def test_proximity_falls_off_by_patches():
    mask = np.zeros((4, 100), bool)
    mask[:, :20] = True
    near = np.asarray(edge_proximity(jnp.asarray(mask), 14))[0]
    assert near[20] == pytest.approx(np.exp(-1 / 14))
    assert near[33] == pytest.approx(np.exp(-1))
    assert near[19] == near[20]
    assert near[90] == 0


def passes(second: bool = True) -> Passes:
    generator = np.random.default_rng(0)
    depth, confidence = generator.uniform(1, 3, (2, 1, 2, 28, 42)).astype(np.float32)
    saliency = generator.random((1, 2, 2, 3)).astype(np.float32)
    pixels = jax.image.resize(jnp.asarray(saliency), (1, 2, 28, 42), "bilinear", antialias=False)
    one = Predictions(depth=jnp.asarray(depth), depth_confidence=jnp.asarray(confidence))
    return Passes(one, one if second else None, jnp.asarray(saliency), pixels >= 0.6)


def test_observations_of_passes():
    both = passes()
    seen = observe(both, scale=jnp.asarray([2.0]))
    assert np.allclose(seen.depth2, 2 * seen.depth1)
    assert np.allclose(np.exp(seen.log_confidence1), np.asarray(both.first.depth_confidence), rtol=1e-6)
    assert ((np.asarray(seen.margin) >= 0) == np.asarray(both.dynamic_mask)).all()  # cut where the mask was
    saliency, log_depth, _, dynamic = np.moveaxis(np.asarray(seen.features), -1, 0)
    assert np.median(log_depth) == pytest.approx(0, abs=1e-3)
    assert (dynamic == np.asarray(both.dynamic_mask)).all()
    assert saliency.min() >= 0


def test_soft_masks_become_masks_that_were_given():
    """However they came about, and where the saliency says otherwise."""
    both = passes()
    given = jnp.asarray(np.random.default_rng(5).random(both.dynamic_mask.shape) < 0.3)
    for mask in (given, jnp.zeros_like(given), jnp.ones_like(given)):
        seen = observe(both._replace(dynamic_mask=mask))
        assert ((np.asarray(seen.margin) >= 0) == np.asarray(mask)).all()
    nothing = observe(both._replace(dynamic_mask=jnp.zeros_like(given)))
    assert np.asarray(soft_mask(nothing.margin, jnp.asarray(5.0))).max() < 1e-6


def test_a_missing_pass_is_one_sentence():
    with pytest.raises(InputError, match="both passes"):
        observe(passes(second=False))
