"""The family of fusion rules: the paper's as its default, the theory of correlated observations, extremes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.shared.simulated import scattered
from vggtjax import fuse_depth
from vggtjax.errors import InputError
from vggtjax.method.fusion import family
from vggtjax.method.fusion.family import (
    FEATURES,
    PARTS,
    Observations,
    is_free,
    log_precisions,
    paper_rule,
    parse_family,
    projected,
    soft_mask,
    start,
)

SHAPE = (2, 3, 4)
fuse = jax.jit(family.fuse)
_maps = hnp.arrays(np.float32, SHAPE, elements=st.floats(1, 100, width=32))
_logs = hnp.arrays(np.float32, SHAPE, elements=st.floats(0, 69, width=32))


def seen(d1: Any, c1: Any, d2: Any, c2: Any, dynamic: Any, features: Any = None) -> Observations:
    d1, c1, d2, c2 = (jnp.broadcast_to(jnp.asarray(x, jnp.float32), np.shape(dynamic)) for x in (d1, c1, d2, c2))
    dynamic = jnp.asarray(dynamic, jnp.float32)
    features = jnp.zeros((*dynamic.shape, len(FEATURES))) if features is None else features
    return Observations(d1, jnp.log(c1), d2, jnp.log(c2), dynamic, dynamic - 0.5, features)


@settings(max_examples=50)
@given(_maps, _logs, _maps, _logs, hnp.arrays(bool, SHAPE))
def test_the_identity_is_the_papers_rule(d1, log1, d2, log2, dynamic):
    """For confidences from 1 to 1e30; a precision is as exact as its logarithm, which it is kept as."""
    c1, c2 = np.exp(log1), np.exp(log2)
    depth, confidence = fuse_depth(d1, c1, d2, c2, dynamic)
    fused = fuse(paper_rule(), seen(d1, c1, d2, c2, dynamic))
    assert np.allclose(fused.depth, depth, rtol=1e-6, atol=0)
    assert np.allclose(fused.log_precision, np.log(confidence), rtol=1e-6, atol=1e-6)


@settings(max_examples=50)
@given(
    variances=st.tuples(st.floats(0.01, 100), st.floats(0.01, 100)),
    correlation=st.floats(-0.95, 0.95),
    depths=st.tuples(st.floats(1, 5), st.floats(1, 5)),
)
def test_correlated_passes_are_joined_by_generalised_least_squares(variances, correlation, depths):
    covariance = correlation * np.sqrt(variances[0] * variances[1])
    inverse = np.linalg.inv([[variances[0], covariance], [covariance, variances[1]]])
    precision = inverse.sum()
    best = inverse.sum(axis=0) @ depths / precision
    params = paper_rule() | {"correlation": jnp.asarray(correlation, jnp.float32)}
    fused = fuse(params, seen(depths[0], 1 / variances[0], depths[1], 1 / variances[1], np.zeros((1, 1, 1))))
    scale = np.abs(inverse.sum(axis=0) / precision) @ np.abs(depths)  # weights can cancel
    assert abs(fused.depth.item() - best) < 1e-4 * scale
    assert np.isclose(fused.precision.item(), precision, rtol=2e-3)


def test_an_offset_moves_hard_masks_too():
    maps = seen(2.0, 1.0, 4.0, 1.0, np.zeros((1, 1, 3)))._replace(margin=jnp.asarray([[[-0.3, -0.1, 0.1]]]))
    for temperature in (0.0, 1e-5):
        fused = fuse(paper_rule() | {"offset": jnp.asarray(-0.2), "temperature": jnp.asarray(temperature)}, maps)
        assert np.allclose(fused.dynamic, [[[0, 1, 1]]], atol=1e-6)


def test_floors_hold_however_small_the_precision():
    for power in (-1.0, -2.0, -4.0):
        params = paper_rule() | {"power": jnp.full(2, power), "floor": jnp.asarray([1.0, 0.0])}
        first, second = log_precisions(params, seen(2.0, 1e30, 2.0, 1e30, np.zeros((1, 1, 1))))
        assert first.item() == pytest.approx(0, abs=1e-6)
        assert second.item() == pytest.approx(power * np.log(1e30), rel=1e-6)


def test_the_gradient_of_a_very_cold_mask_is_a_number():
    with jax.debug_nans(True):
        for temperature in (1e-30, 1e-20, 1e-6):
            slope = jax.grad(lambda t: soft_mask(jnp.asarray([-0.1, 0.0, 0.1]), t).sum())(jnp.asarray(temperature))
            assert np.isfinite(slope)


def test_claims_by_hand():
    features = jnp.asarray([[[[0.5, -1.0, 0.25, 1.0]]]])
    maps = seen(2.0, 4.0, 3.0, 9.0, np.zeros((1, 1, 1)), features)
    params = paper_rule() | {
        "scale": jnp.asarray([0.1, 0.2]),
        "power": jnp.asarray([0.5, 2.0]),
        "floor": jnp.asarray([1.0, 0.5]),
        "saliency": jnp.asarray([1.0, 2.0]),
        "depth": jnp.asarray([0.3, 0.0]),
        "boundary": jnp.asarray([0.0, -4.0]),
        "dynamic": jnp.asarray([-0.5, 0.0]),
    }
    first, second = log_precisions(params, jax.tree.map(lambda x: x[0], maps))
    assert np.exp(first.item()) == pytest.approx(np.exp(0.1 + 0.5 - 0.3 - 0.5) * 2 + 1, rel=1e-5)
    assert np.exp(second.item()) == pytest.approx(np.exp(0.2 + 1.0 - 1.0) * 81 + 0.5, rel=1e-5)


def test_inflation_is_the_birge_ratio():
    """Variances 1/4 and 3/4, three apart: chi^2 is 9, and a fused variance of 3/16 becomes nine times as large."""
    maps = seen(2.0, 4.0, 5.0, 4 / 3, np.zeros((1, 1, 1)))
    fused = fuse(paper_rule() | {"inflation": jnp.asarray(1.0)}, maps)
    assert fused.precision.item() == pytest.approx((4 + 4 / 3) / 9, rel=1e-5)
    assert fused.depth.item() == pytest.approx(2.75, rel=1e-6)
    near = fuse(paper_rule() | {"inflation": jnp.asarray(1.0)}, seen(2.0, 4.0, 2.9, 4 / 3, np.zeros((1, 1, 1))))
    assert near.precision.item() == pytest.approx(4 + 4 / 3, rel=1e-5)  # chi^2 below 1 says nothing


def test_distrust_discounts_a_pass_that_disagrees():
    maps = seen(2.0, 4.0, 5.0, 4 / 3, np.zeros((1, 1, 1)))
    fused = fuse(paper_rule() | {"distrust": jnp.asarray([0.0, 1.0])}, maps)
    weight = (4 / 3 / 9) / (4 + 4 / 3 / 9)
    assert fused.weight.item() == pytest.approx(weight, rel=1e-5)
    assert fused.depth.item() == pytest.approx(2 + 3 * weight, rel=1e-6)


def test_soft_regions_blend_between_their_limits():
    maps = seen(2.0, 3.0, 4.0, 1.0, np.zeros((1, 1, 1)))._replace(margin=jnp.full((1, 1, 1), 0.2))
    for temperature, share in ((0.0, 0.0), (0.2, 1 / (1 + np.exp(-1.0))), (1e-3, 1.0)):
        fused = fuse(paper_rule() | {"temperature": jnp.asarray(temperature)}, maps)
        assert fused.dynamic.item() == pytest.approx(share, abs=1e-6)
        assert fused.depth.item() == pytest.approx(share * 2 + (1 - share) * 2.5, rel=1e-6)
        variance = share**2 / 3 + (1 - share**2) / 4
        assert fused.log_precision.item() == pytest.approx(-np.log(variance), rel=1e-5)


@pytest.mark.parametrize("name", ["full", "gate"])
def test_extremes_have_no_nan(name):
    """Confidence 1 and 1e30, depth 0 and 1e6, nothing and everything moving; values and gradients."""
    grid = np.array(np.meshgrid([1, 1e30], [1, 1e30], [0, 1e6], [0, 1e6], [0, 1])).reshape(5, 1, 4, 8)
    maps = seen(grid[2], grid[0], grid[3], grid[1], grid[4], jnp.ones((1, 4, 8, len(FEATURES))))
    params = scattered(start(parse_family(name)))
    params |= {"inflation": jnp.asarray(2.0), "distrust": jnp.asarray([0.5, 3.0]), "correlation": jnp.asarray(0.99)}

    def total(params, maps):
        fused = fuse(params, maps)
        return jnp.sum(fused.depth) * 1e-6 + jnp.sum(fused.log_precision), fused

    with jax.debug_nans(True):
        for tree in (params, paper_rule()):
            (_, fused), gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))(tree, maps)
            assert all(np.isfinite(x).all() for x in jax.tree.leaves((fused, gradient, fused.precision)))


@jax.jit
def _weighed(params, maps, weights):
    fused = family.fuse(params, maps)
    return jnp.sum(weights[0] * fused.depth) + jnp.sum(weights[1] * fused.log_precision)


_slopes = jax.jit(jax.grad(_weighed))


@pytest.mark.parametrize("name", sorted(PARTS))
def test_gradients_by_finite_differences(name):
    with jax.enable_x64(True):
        generator = np.random.default_rng(3)
        d1, d2 = generator.uniform(1, 3, (2, *SHAPE))
        c1, c2 = np.exp(generator.uniform(0, 3, (2, *SHAPE)))
        maps = Observations(
            jnp.asarray(d1),
            jnp.asarray(np.log(c1)),
            jnp.asarray(d2),
            jnp.asarray(np.log(c2)),
            dynamic=jnp.asarray((generator.random(SHAPE) < 0.3).astype(float)),
            margin=jnp.asarray(generator.uniform(-0.5, 0.5, SHAPE)),
            features=jnp.asarray(generator.uniform(0, 1, (*SHAPE, len(FEATURES)))),
        )
        weights = [jnp.asarray(generator.normal(size=SHAPE)) for _ in range(2)]
        middle = {"floor": 0.3, "inflation": 0.4, "distrust": 0.2, "temperature": 0.3, "correlation": 0.4, "power": 0.8}
        params = {part: jnp.full(PARTS[part].shape, middle.get(part, 0.1)) for part in PARTS}

        def loss(value):
            return _weighed(params | {name: value}, maps, weights)

        gradient = np.asarray(_slopes(params, maps, weights)[name])
        for place in np.ndindex(gradient.shape):
            step = np.zeros(gradient.shape)
            step[place] = 1e-6
            slope = (loss(params[name] + step) - loss(params[name] - step)) / 2e-6
            assert gradient[place] == pytest.approx(float(slope), rel=1e-5, abs=1e-7)
            assert abs(float(slope)) > 1e-4


def test_families_are_sets_of_free_leaves():
    assert parse_family("scale+power") == ("scale", "power")
    assert parse_family("calibrated") == ("scale", "power", "floor")
    assert parse_family("paper") == ()
    free = is_free(start(("scale", "gate")), ("scale", "gate"))
    assert free["scale"]
    assert not free["power"]
    assert all(jax.tree.leaves(free["gate"]))
    with pytest.raises(InputError, match="there is no 'nothing'"):
        parse_family("scale+nothing")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"scal": jnp.zeros(2)}, "the rule has scal; expected the parts scale, power"),
        ({"power": None}, "the rule lacks power"),
        ({"correlation": jnp.zeros(2)}, r"part correlation of the rule has shape \(2,\); expected \(\)"),
    ],
)
def test_a_misspelt_rule_is_refused(change, sentence):
    rule = {name: value for name, value in (paper_rule() | change).items() if value is not None}
    with pytest.raises(InputError, match=sentence):
        family.fuse(rule, seen(1, 1, 1, 1, np.zeros(SHAPE)))


def test_projection_keeps_ranges():
    params = projected({name: jnp.full(part.shape, 1e9) for name, part in PARTS.items()})
    assert all((np.asarray(params[name]) <= part.high).all() for name, part in PARTS.items())
    params = projected({name: jnp.full(part.shape, -1e9) for name, part in PARTS.items()})
    assert params["floor"].tolist() == [0, 0]
    assert params["correlation"].item() == pytest.approx(-0.99)
