"""The page that all reconstructions call: who calls it, given masks, rules of one's own, and equal frames."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from jax.tree_util import Partial

from tests.shared.tiny import tiny_model
from vggtjax import Clips, Options, assemble, encode, forward, infer, load_clip, reconstruct, reconstruct_long
from vggtjax.clips.truth import Truth
from vggtjax.config import MotionConfig
from vggtjax.errors import InputError
from vggtjax.method.algorithm import run_method, run_passes
from vggtjax.method.fusion.family import fuse
from vggtjax.method.fusion.inputs import observe
from vggtjax.method.soft_mask import soft_pixels
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.batch.many import reconstruct_many
from vggtjax.pipeline.run import compile_ahead
from vggtjax.pipeline.several import reconstruct_methods
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.research.evaluation.ladder import ladder
from vggtjax.research.learning import paper_rule, reconstruct_soft, soft_masking

SIDE, FRAMES = 28, 4
IMAGES: Any = np.random.default_rng(0).random((2, FRAMES, SIDE, SIDE, 3), np.float32)
MASKS: Any = np.zeros(IMAGES.shape[:4], bool)
MASKS[0, :, :14, :14] = True


@pytest.fixture(scope="module")
def model() -> Model:
    """Return a network under which blocks matter: LayerScale starts at 0.01 in training."""
    made = tiny_model(image_size=SIDE)
    for blocks in ("frame_blocks", "global_blocks"):
        for name in ("scale1", "scale2"):
            made.params["aggregator"][blocks][name] = jnp.ones_like(made.params["aggregator"][blocks][name])
    return made


def _mean(seen):
    return (seen.depth1 + seen.depth2) / 2, jnp.full_like(seen.depth1, 2)


class ReachedError(Exception):
    """What the first step of the page raises."""


def _callers(model, clip, folder):
    config, poses = model.config, np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    truth = Truth(clip.images, np.ones(MASKS.shape[1:]), MASKS[0], poses, poses[..., :3])
    return {
        "infer": lambda: infer(model.params, IMAGES, config),
        "reconstruct": lambda: reconstruct(model, clip),
        "compile_ahead": lambda: compile_ahead(model, FRAMES, SIDE, SIDE),
        "several methods": lambda: reconstruct_methods(model, clip, ["vggt", "4dvggt-d"]),
        "ladder": lambda: ladder(model, truth),
        "soft masks": lambda: reconstruct_soft(model.params, IMAGES, config, soft_masking(config)),
        "batch": lambda: next(reconstruct_many(model, {"clip": IMAGES[0]}, folder / "b")),
        "windows": lambda: reconstruct_long(model, np.concatenate(IMAGES), folder / "c", Windows(4, 2)),
    }


def test_nothing_else_codes_the_flow(model, tmp_path, monkeypatch):
    """A changed page changes whoever reconstructs: here its first step, where all of them end."""

    def ends(*arguments, **options):
        raise ReachedError

    monkeypatch.setattr("vggtjax.method.algorithm.encode", ends)
    callers = _callers(model, load_clip(IMAGES[0], size=SIDE), tmp_path)
    for name, call in callers.items():
        try:
            call()
        except ReachedError:
            continue
        pytest.fail(f"{name} does not call the page")


def test_masks_of_a_batch_are_those_of_its_clips(model):
    made, passes = infer(model.params, IMAGES, model.config, masks=MASKS)
    assert (np.asarray(passes.dynamic_mask) == MASKS).all()
    for i, clip in enumerate(IMAGES):
        alone, _ = infer(model.params, clip[None], model.config, masks=MASKS[i : i + 1])
        assert np.allclose(made.depth[i], alone.depth[0], rtol=1e-5)
    unmoved, _ = infer(model.params, IMAGES, model.config, masks=False)
    assert np.allclose(unmoved.depth[1], made.depth[1], rtol=1e-5)
    assert not np.allclose(unmoved.camera_from_world[0], made.camera_from_world[0], atol=1e-5)
    for masks, sentence in (
        (MASKS[:1], r"or of shares as floats, of shape \(2, 4, 28, 28\)"),
        (MASKS.astype(np.uint8), r"masks have type uint8; expected bool, .*: masks\.astype\(bool\)"),
    ):
        with pytest.raises(InputError, match=sentence):
            infer(model.params, IMAGES, model.config, masks=masks)


def test_infer_takes_a_model(model):
    depth, _ = infer(model, IMAGES, method="vggt")
    expected, _ = infer(model.params, IMAGES, model.config, method="vggt")
    for same in (depth, jax.jit(lambda images: infer(model, images, method="vggt")[0])(jnp.asarray(IMAGES))):
        np.testing.assert_allclose(same.depth, expected.depth, rtol=1e-5)
    with pytest.raises(InputError, match="config is not the configuration of the model; leave it out, or give model"):
        infer(model, IMAGES, dataclasses.replace(model.config, motion=MotionConfig(floor=0.5)))
    with pytest.raises(InputError, match=r"a model is no argument of jit; close over it, or give model\.params"):
        jax.jit(lambda traced: infer(traced, IMAGES))(jnp.zeros(3))
    with pytest.raises(InputError, match=r"masks have values from 0 to 2; expected shares in \[0, 1\]"):
        infer(model, IMAGES, masks=jnp.zeros(IMAGES.shape[:4]).at[0, 0].set(2))
    with pytest.raises(InputError, match=r"config is missing; give infer\(model, images\) or infer\(model\.params"):
        infer(model.params, IMAGES)
    with pytest.raises(InputError, match="config is a Model; give infer"):
        infer(model.params, IMAGES, model)


@pytest.mark.parametrize("call", [encode, forward, run_method, run_passes])
def test_functions_of_parameters_say_what_to_give_for_a_model(model, call):
    with pytest.raises(
        InputError, match=r"in place of its parameters; give model\.params, and model\.config as config"
    ):
        call(model, jnp.asarray(IMAGES), model.config)


def test_a_function_is_a_rule_of_fusion(model):
    def rule(weight, seen):
        return seen.depth1 * weight + seen.depth2 * (1 - weight), jnp.full_like(seen.depth1, 2)

    images = jnp.asarray(IMAGES)

    @jax.jit
    def depth(weight):
        made, passes = infer(model.params, images, model.config, fusion=Partial(rule, weight))
        depths: Any = passes.first.depth, passes.second.depth  # type: ignore[union-attr]
        return made.depth.mean(), (depths[0] - depths[1]).mean()

    gradient, difference = jax.grad(depth, has_aux=True)(0.25)
    assert gradient == pytest.approx(float(difference), rel=1e-3)
    one_map: Any = lambda seen: seen.depth1  # noqa: E731
    made = reconstruct(model, load_clip(IMAGES[0], size=SIDE), fusion=lambda seen: (seen.depth1, 3 + 0 * seen.depth2))
    assert (made.depth_confidence == 3).all()
    assert "lambda" in made.settings["fusion"]
    with pytest.raises(InputError, match=r"returned 1 array of shape \(2, 4, 28, 28\); expected a pair \(depth"):
        infer(model.params, IMAGES, model.config, fusion=one_map)
    with pytest.raises(InputError, match="method 'vggt' does not fuse"):
        infer(model.params, IMAGES, model.config, fusion=one_map, method="vggt")


def test_a_rule_is_for_methods_that_fuse(model):
    passes = run_passes(model.params, jnp.asarray(IMAGES), model.config)
    with pytest.raises(InputError, match="method 'vggt' does not fuse"):
        assemble(passes, paper_rule(), method="vggt")
    with pytest.raises(
        InputError, match="fusion is 'vggt'; expected a rule of fusion; a method's name is given as met"
    ):
        assemble(passes, "vggt")  # type: ignore[arg-type]


def test_soft_masks_of_any_caller_are_those_of_the_soft_method(model):
    images = jnp.asarray(IMAGES)
    masking = soft_masking(model.config, temperature=0.1)
    soft = jax.jit(reconstruct_soft, static_argnames="config")(model.params, images, model.config, masking)
    made, passes = infer(model.params, images, model.config, masks=masking)
    # Two programs round differently, which grows in the product of the five maps, most where a map hardly varies.
    depths: Any = passes.first.depth, soft.passes.first.depth
    assert np.allclose(*depths, rtol=1e-5)
    assert np.abs(passes.saliency - soft.passes.saliency).mean() < 5e-3
    for found in (passes, soft.passes):
        shares = soft_pixels(found.saliency, masking, size=(SIDE, SIDE), threshold="otsu")
        assert np.allclose(found.dynamic_mask, shares, atol=1e-5)
    assert np.allclose(made.depth, fuse(paper_rule(), observe(passes)).depth, rtol=1e-5)

    def depth(masking, method):
        return (infer(model.params, images, model.config, masks=masking, method=method)[0].depth * images[..., 0]).sum()

    for method in ("4dvggt-d", "hard-replacement"):
        gradient = jax.grad(depth)(masking, method)
        assert all(np.abs(leaf).max() > 0 for leaf in gradient), method


def test_small_shares_are_nearly_static(model):
    for method in ("4dvggt-d", "hard-replacement"):
        run: Any = partial(infer, model.params, IMAGES, model.config, method=method, align_scale=True)
        (small, _), (none, _) = run(masks=np.full(MASKS.shape, 1e-4, np.float32)), run(masks=MASKS & False)
        assert np.allclose(small.depth, none.depth, rtol=1e-3), method


@pytest.mark.parametrize("soft", [False, True])
def test_padded_frames_change_nothing(model, soft):
    """Of clips that jit traces; whatever the padded frames show, also where all real frames are equal."""
    masks = soft_masking(model.config, temperature=0.1) if soft else None
    images = np.stack([np.repeat(IMAGES[0, :1], FRAMES, axis=0), IMAGES[1]])
    padded: Any = np.concatenate([images, np.random.default_rng(1).random((2, 2, SIDE, SIDE, 3), np.float32)], axis=1)

    @partial(jax.jit, static_argnames="config")
    def run(params, clips, masks, config):
        return run_method(params, clips, config, masks=masks)

    made, passes = run(model.params, Clips(jnp.asarray(padded), frames=FRAMES), masks, model.config)
    alone, their_passes = run(model.params, Clips(jnp.asarray(images)), masks, model.config)
    assert np.allclose(made.depth, alone.depth, rtol=1e-4)
    mask = np.asarray(passes.dynamic_mask)[:, :FRAMES]
    assert not mask[0].any()
    # Rounding of the five maps grows in their normed product: saliencies differ by 3e-4 on some processors.
    assert np.allclose(mask, their_passes.dynamic_mask, atol=1e-3)
    for frames in (0, 7):
        with pytest.raises(InputError, match=f"frames is {frames}; expected a number from 1 to 6"):
            run_method(model.params, Clips(padded, frames=frames), model.config)
    with pytest.raises(InputError, match="clips with query_points are padded"):
        run_method(model.params, Clips(padded, {0: jnp.ones((2, 1, 2))}, FRAMES), model.config)


def test_masks_and_rules_on_a_mesh(model):
    mesh = Mesh(np.array(jax.devices()[:1]), ("frames",))
    run: Any = partial(infer, model.params, IMAGES, model.config, fusion=_mean)
    for masks in (MASKS, False):
        (made, passes), (alone, _) = run(masks=masks, mesh=mesh), run(masks=masks)
        assert (np.asarray(passes.dynamic_mask) == (MASKS & (masks is not False))).all()
        assert np.allclose(made.depth, alone.depth, rtol=1e-4)
        assert (np.asarray(made.confidence) == 2).all()
    for masks, sentence in (
        (
            np.concatenate([MASKS, MASKS], axis=1),
            r"masks are bool of shape \(2, 8, 28, 28\); expected an array of bool",
        ),
        (True, r"masks are bool of shape \(\); expected an array of bool"),
        (soft_masking(model.config), "masks are soft and frames are on several devices"),
    ):
        with pytest.raises(InputError, match=sentence):
            run(masks=masks, mesh=mesh)


def test_shared_passes_need_what_is_read(model):
    run: Any = partial(run_passes, model.params, jnp.asarray(IMAGES), model.config)
    shared = run()
    again = run(masks=jnp.asarray(MASKS), shared=shared)
    assert again.first is shared.first
    assert np.allclose(again.second.pose_encoding, run(masks=jnp.asarray(MASKS)).second.pose_encoding, atol=1e-5)
    for changed, options, masks, sentence in (
        (shared._replace(features=None), Options(), None, "shared has no features"),
        (shared, Options(mask="matches"), None, "shared has no matches between frames"),
        (shared, Options(), soft_masking(model.config), "masks are soft and change the first pass"),
    ):
        with pytest.raises(InputError, match=sentence):
            run(options=options, masks=masks, shared=changed)


def test_equal_frames_have_an_empty_mask_for_every_caller(model):
    images: Any = np.stack([np.repeat(IMAGES[0, :1], FRAMES, axis=0), IMAGES[1]])
    config = model.config
    for passes in (
        infer(model.params, images, config)[1],
        reconstruct_soft(model.params, jnp.asarray(images), config, soft_masking(config)).passes,
        run_method(model.params, Clips(jnp.asarray(images)), config)[1],
    ):
        share = np.asarray(passes.dynamic_mask).mean(axis=(1, 2, 3))
        assert share[0] == 0 < share[1]
