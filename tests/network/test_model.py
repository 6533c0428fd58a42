"""Properties of the whole network: batches, permutations, transformations, the branch on the per-layer flag."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.da3 import TINY as DA3_TINY
from tests.shared.seeded import seeded_images
from tests.shared.tiny import tiny_config
from vggtjax import VGGTConfig, forward
from vggtjax.config import FAMILIES, vggt_1b
from vggtjax.errors import InputError
from vggtjax.network.heads.dpt_head import DENSE_HEADS, DenseMap
from vggtjax.network.kernels.narrow import narrowed
from vggtjax.network.model import FIELDS, HEADS, init_params, parameter_shapes
from vggtjax.network.suppression import Suppression

SIZE = (28, 42)


@pytest.fixture(scope="module")
def images():
    """Two clips of three frames."""
    return np.stack([seeded_images(3, *SIZE, seed) for seed in range(2)]).transpose(0, 1, 3, 4, 2)


@pytest.fixture(scope="module")
def mask(images):
    return np.random.default_rng(0).random((2, 3, 2, 3)) < 0.4


_forward = jax.jit(forward, static_argnames=("config", "suppress", "outputs", "compute_dtype"))


def close(a, b, tolerance=1e-4):
    scale = max(float(np.std(b)), 1e-6)
    return np.abs(np.asarray(a) - np.asarray(b)).max() <= tolerance * scale


def test_a_batch_of_clips_equals_clip_by_clip(params, config, images, mask):
    batch = _forward(params, images, config, dynamic_tokens=mask)
    for b in range(2):
        alone = _forward(params, images[b : b + 1], config, dynamic_tokens=mask[b : b + 1])
        for name in ("pose_encoding", "depth", "depth_confidence"):
            assert close(getattr(batch, name)[b], getattr(alone, name)[0]), name


def test_keys_are_suppressed_in_the_pairs_that_the_model_recommends(params, config, images, mask):
    other = dataclasses.replace(config, motion=dataclasses.replace(config.motion, mask_pairs=1))
    made = [_forward(params, images[:1], c, dynamic_tokens=mask[:1], **given).pose_encoding
            for c, given in ((other, {}), (config, {"mask_pairs": 1}), (config, {}))]  # fmt: skip
    assert close(made[0], made[1])
    assert not close(made[0], made[2])


def test_the_program_of_an_accelerator_gives_the_same(monkeypatch, params, config, images, mask):
    """Rows padded to a multiple of eight, taps of two of three frames at a time; a CPU runs what is for others."""
    given = {"config": config, "dynamic_tokens": mask, "outputs": ("camera", "depth")}
    wanted = _forward(params, images, **given)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *inputs, default, **_: default(*inputs))
    monkeypatch.setattr("vggtjax.network.kernels.pieces._rows_on_cpu", lambda rows: 1)
    monkeypatch.setattr("vggtjax.network.kernels.captured.ROWS_AT_ONCE", 44)
    made = forward(params, images, **given)
    for name in ("pose_encoding", "depth", "depth_confidence"):
        assert close(getattr(made, name), getattr(wanted, name)), name


def test_permuting_later_frames_permutes_the_outputs(params, config, images, mask):
    order = [0, 2, 1]
    plain = _forward(params, images, config, dynamic_tokens=mask)
    permuted = _forward(params, images[:, order], config, dynamic_tokens=mask[:, order])
    for name in ("pose_encoding", "depth", "depth_confidence"):
        assert close(getattr(permuted, name), getattr(plain, name)[:, order]), name
    assert not close(permuted.pose_encoding, plain.pose_encoding)


def _conds(jaxpr, inside_scan=False):
    """Yield (predicate's shape, whether inside a scan) of every cond but the choice of a platform."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "cond" and not equation.params.get("branches_platforms"):
            yield equation.invars[0].aval.shape, inside_scan
        for value in equation.params.values():
            for inner in jax.tree.leaves(value, is_leaf=lambda x: hasattr(x, "jaxpr") or hasattr(x, "eqns")):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _conds(inner, inside_scan or equation.primitive.name == "scan")


def test_the_flag_of_a_layer_is_a_branch_even_for_batches(config, images, mask):
    params = parameter_shapes(config)
    run = partial(forward, config=config, outputs=("camera",))

    def count(dynamic):
        def call(params, images, dynamic):
            return run(params, images, dynamic_tokens=dynamic)

        call = jax.vmap(call, in_axes=(None, 0, 0 if dynamic is not None else None))
        found = list(_conds(jax.make_jaxpr(call)(params, images[:, None], dynamic).jaxpr))
        assert all(predicate == () for predicate, _ in found)
        return sum(inside for _, inside in found)

    assert count(mask[:, None]) == count(None) + 2  # one in the frame block, one in the global block


def test_the_gradient_is_the_slope_under_remat(params, config, images, mask):
    """Of the cameras, and of the first frame's depth, which the other frames reach through attention."""

    def loss(pixels):
        made = forward(
            params,
            pixels,
            config,
            dynamic_tokens=mask[:1],
            outputs=("camera", "depth"),
            stop_camera_gradient=False,
        )
        assert made.pose_encoding is not None
        assert made.depth is not None
        return jnp.sum(made.pose_encoding**2) + jnp.mean(jnp.log(made.depth[:, 0]))

    value, gradient = jax.jit(loss), jax.jit(jax.grad(jax.checkpoint(loss)))
    made = np.asarray(gradient(images[:1]))
    assert (np.abs(made).max(axis=(2, 3, 4)) > 0).all()
    direction = np.random.default_rng(1).normal(size=made.shape).astype(np.float32)
    direction *= 0.1 / np.linalg.norm(direction)
    ahead, behind = (float(value(images[:1] + sign * direction)) for sign in (1, -1))
    assert (ahead - behind) / 2 == pytest.approx(float(np.sum(made * direction)), rel=0.01)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"images": np.zeros((1, 2, 28, 41, 3))}, "multiples of the patch size 14"),
        ({"images": np.zeros((1, 2, 28, 42, 3), np.uint8)}, "images have type uint8; expected floats in .0, 1."),
        ({"dynamic_tokens": np.zeros((1, 2, 3, 2), bool)}, r"expected \(1, 2, 2, 3\)"),
        ({"suppress": "forget"}, "expected one of zero, drop"),
        ({"suppression": Suppression(mask_pairs=-1)}, "at least 0"),
        ({"frame_count": np.array([2, 2])}, r"frame_count has shape \(2,\); expected \(1,\)"),
    ],
)
def test_bad_arguments_are_named(params, config, change, sentence):
    arguments = {"images": np.zeros((1, 2, 28, 42, 3)), **change}
    with pytest.raises(InputError, match=sentence):
        forward(params, config=config, **arguments)


def test_parameters_without_a_head_of_the_configuration_are_named(params, config):
    run: Any = partial(forward, {name: value for name, value in params.items() if name != "depth_head"})
    with pytest.raises(InputError, match="params has no 'depth_head'; the configuration names the head 'depth'"):
        run(np.zeros((1, 2, 28, 42, 3)), config)


@pytest.mark.parametrize("config", [tiny_config(), DA3_TINY], ids=str)
def test_every_head_fills_its_fields(config):
    assert config.heads == config.row.heads
    assert {name for family in FAMILIES.values() for name in family.heads} == set(HEADS)
    images = np.zeros((1, 2, 28, 42, 3), np.float32)
    for name in config.heads:
        queries = np.ones((1, 1, 2), np.float32) if name == "tracks" else None
        run = partial(forward, config=config, outputs=(name,))
        made = jax.eval_shape(run, parameter_shapes(config), images, query_points=queries)
        assert tuple(field for field, value in made._asdict().items() if value is not None) == FIELDS[name]


def test_a_row_of_the_table_is_a_dense_head(monkeypatch, config):
    """One value a pixel, without an axis; an output that no code makes is an error, not None."""
    sky = DenseMap("sky_head", "depth", values=1, activate=jax.nn.sigmoid)
    row_of_vggt = FAMILIES["vggt"]
    monkeypatch.setitem(FAMILIES, "vggt", dataclasses.replace(row_of_vggt, heads=(*row_of_vggt.heads, "sky")))
    for table, row in ((HEADS, sky.module), (FIELDS, sky.fields), (DENSE_HEADS, sky)):
        monkeypatch.setitem(table, "sky", row)
    config = dataclasses.replace(config, heads=("camera", "sky"))
    params = init_params(0, config)
    images: Any = np.zeros((1, 2, 28, 42, 3), np.float32)
    run: Any = partial(forward, params, images, config, outputs=("sky",))
    assert set(params) == {"backbone", "aggregator", "camera_head", "sky_head"}
    made = run()
    assert made.depth.shape == (1, 2, 28, 42)
    assert (jnp.abs(made.depth - 0.5) < 0.5).all()
    assert (made.depth_confidence >= 1).all()
    monkeypatch.delitem(DENSE_HEADS, "sky")
    with pytest.raises(KeyError, match="sky"):
        run()


def test_weights_that_a_gpu_holds_of_vggt_1b():
    """Without the heads of points and tracks, which a reconstruction does not read."""
    held = jax.eval_shape(partial(narrowed, compute_dtype="bfloat16"), parameter_shapes(vggt_1b()))
    sizes = {
        head: sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree)) for head, tree in held.items()
    }
    assert 2.3e9 < sum(sizes[head] for head in ("backbone", "aggregator", "camera_head", "depth_head")) < 2.6e9


def test_full_size_parameters():
    shapes = parameter_shapes(VGGTConfig())
    count = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(shapes))
    assert count == 1_256_536_492  # all of VGGT-1B but the mask token of its backbone's pre-training
