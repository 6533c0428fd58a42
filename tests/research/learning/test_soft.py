"""Soft masks: the method itself in the limit, and every gradient against finite differences in float64."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from tests.shared.tiny import tiny_config
from vggtjax import forward, infer, init_params
from vggtjax.errors import InputError
from vggtjax.method.fusion.family import paper_rule
from vggtjax.method.soft_mask import SoftMasking, soft_masking
from vggtjax.research.learning.distances import pose_error
from vggtjax.research.learning.soft import reconstruct_soft

CONFIG = tiny_config(patch_size=8, image_size=32, taps=(0, 1, 2, 3))
SHAPE = (1, 4, 16, 24, 3)


@functools.cache
def params():
    """Return weights under which blocks matter: LayerScale starts at 0.01 in training."""
    tree = init_params(0, CONFIG)
    for blocks in ("frame_blocks", "global_blocks"):
        for name in ("scale1", "scale2"):
            tree["aggregator"][blocks][name] = jnp.ones_like(tree["aggregator"][blocks][name])
    return tree


def images(seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).random(SHAPE), jnp.float32)


_STATIC = ("config", "gram", "motion", "stop_camera_gradient", "compute_dtype", "remat")
softly = jax.jit(reconstruct_soft, static_argnames=_STATIC)


@pytest.mark.parametrize("threshold", [None, pytest.param("multi-otsu", marks=pytest.mark.proof)])
def test_at_temperature_0_it_is_the_method(threshold):
    config = dataclasses.replace(CONFIG, motion=dataclasses.replace(CONFIG.motion, threshold=threshold))
    assembly, passes = infer(params(), images(), config)
    assert 0 < np.asarray(passes.dynamic_mask).mean() < 1
    soft = softly(params(), images(), config, soft_masking(config), paper_rule())
    assert (np.asarray(soft.dynamic) == np.asarray(passes.dynamic_mask)).all()
    assert np.allclose(soft.depth, assembly.depth, rtol=2e-6)
    assert np.allclose(np.exp(soft.log_precision), assembly.confidence, rtol=1e-5)
    assert np.allclose(soft.cameras.camera_from_world, assembly.camera_from_world, atol=1e-6)


@jax.jit
def _second(tree, pictures, tokens, mask_pairs=5, strength=None):
    how = {"dynamic_tokens": tokens, "mask_pairs": mask_pairs, "strength": strength}
    return forward(tree, pictures, CONFIG, outputs=("camera",), **how).pose_encoding


def test_shares_of_0_and_1_are_the_boolean_mask():
    second = functools.partial(_second, params(), images())
    tokens = jnp.asarray(np.random.default_rng(0).random((1, 4, 2, 3)) < 0.4)
    for pairs in (0, 2, 5):
        assert np.allclose(second(tokens, pairs), second(tokens.astype(jnp.float32), pairs), rtol=1e-5, atol=1e-6)
    ones = jnp.where(jnp.arange(4) < 2, 1.0, 0.0)
    assert np.allclose(second(tokens, strength=ones), second(tokens, 2), rtol=1e-5, atol=1e-6)
    assert not np.allclose(second(0.5 * tokens, 2), second(tokens, 2), rtol=1e-4)
    assert np.allclose(second(0.5 * tokens, 2), second(tokens, strength=0.5 * ones), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"suppress": "drop"}, "dropped in part"),
        ({"strength": jnp.ones(3)}, r"strength has shape \(3,\); expected \(4,\)"),
        ({"dynamic_tokens": jnp.ones((1, 4, 2, 3), int)}, "expected bool, or shares"),
        ({"compute_dtype": "float64"}, "enable_x64"),
    ],
)
def test_bad_shares_are_one_sentence(options, sentence):
    options, tree = {"dynamic_tokens": jnp.ones((1, 4, 2, 3))} | options, params()
    with pytest.raises(InputError, match=sentence):
        jax.eval_shape(lambda: forward(tree, images(), CONFIG, **options))


def _in_float64(tree):
    return jax.device_put(jax.tree.map(lambda x: np.asarray(x, np.float64), tree))


@pytest.mark.proof
def test_every_gradient_by_finite_differences():
    """Of depth, precision, points and cameras along a random direction of each knob: masks, fusion and a weight."""
    weights32, pictures32 = params(), images(1)
    with jax.enable_x64(True):
        weights, pictures = _in_float64(weights32), _in_float64(pictures32)
        shares = {"strength": [0.9, 0.7, 0.4, 0.2], "exponents": [1.2, 0.7, 1.0, 0.9, 1.1]}
        masking = _in_float64(soft_masking(CONFIG, temperature=0.15))
        masking = masking._replace(**{name: jnp.asarray(values) for name, values in shares.items()})
        fusion = _in_float64(paper_rule()) | {"temperature": jnp.asarray(0.3), "floor": jnp.asarray([0.1, 0.2])}
        generator = np.random.default_rng(2)
        true = jnp.concatenate([jnp.tile(jnp.eye(3), (4, 1, 1)), jnp.asarray(generator.normal(size=(4, 3, 1)))], axis=2)
        mix = [jnp.asarray(generator.normal(size=(1, 4, 16, 24))) for _ in range(2)]

        @jax.jit
        def loss(knobs):
            masking, fusion, bias = knobs
            tree = weights | {"aggregator": weights["aggregator"] | {"camera_token": bias}}
            how = {"stop_camera_gradient": False, "compute_dtype": "float64", "remat": True}
            made = reconstruct_soft(tree, pictures, CONFIG, masking, fusion, **how)
            outputs = {
                "depth": jnp.mean(mix[0] * made.depth) + jnp.mean(mix[1] * made.log_precision),
                "cameras": sum(pose_error(made.cameras.camera_from_world[0], true)),
                "points": jnp.mean(mix[0][..., None] * made.points),
            }
            return sum(outputs.values()), outputs

        knobs = (masking, fusion, weights["aggregator"]["camera_token"])
        gradient, _ = jax.jit(jax.grad(loss, has_aux=True))(knobs)
        still = jax.tree.map(jnp.zeros_like, knobs)
        drawn = jax.tree.map(lambda leaf: jnp.asarray(generator.normal(size=leaf.shape)), knobs)
        directions = {
            name: (still[0]._replace(**{name: getattr(drawn[0], name)}), *still[1:]) for name in SoftMasking._fields
        }
        directions |= {"fusion": (still[0], drawn[1], still[2]), "camera_token": (*still[:2], drawn[2])}
        step = 1e-7  # so small that no pixel changes its bin of Otsu's histogram
        for name, direction in directions.items():
            ends = [loss(jax.tree.map(lambda x, d, s=sign: x + s * step * d, knobs, direction)) for sign in (1, -1)]
            slope = float(ends[0][0] - ends[1][0]) / (2 * step)
            along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: float((g * d).sum()), gradient, direction)))
            assert along == pytest.approx(slope, rel=2e-4, abs=2e-8), name
            moved = {output for output, value in ends[0][1].items() if abs(value - ends[1][1][output]) > 1e-14}
            # Masks move everything; the rule of fusion moves depth and points, and not the cameras.
            assert moved == ({"depth", "points"} if name == "fusion" else {"depth", "points", "cameras"}), name


def test_the_fusion_gradient_does_not_go_through_the_network():
    """What is differentiated by the fusion alone has the loops over blocks of the forward pass, and not one more."""
    tree, pictures, masking = params(), images(), soft_masking(CONFIG)

    def loss(fusion):
        return softly(tree, pictures, CONFIG, masking, fusion).depth.mean()

    def loops(jaxpr) -> int:
        inner = [loops(part) for equation in jaxpr.eqns for part in jaxprs_in_params(equation.params)]
        return sum(inner) + sum(equation.primitive.name == "scan" for equation in jaxpr.eqns)

    plain, gradient = (loops(jax.make_jaxpr(function)(paper_rule()).jaxpr) for function in (loss, jax.grad(loss)))
    assert gradient == plain > 3
