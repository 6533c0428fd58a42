"""Two passes and every method made of them; the staged pipeline against the single jit."""

from contextlib import contextmanager
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.seeded import seeded_images
from tests.shared.tiny import tiny_model
from vggtjax import (
    METHODS,
    assemble,
    decode_pose,
    encode,
    forward,
    fuse_depth,
    infer,
    load_clip,
    reconstruct,
    run_passes,
)
from vggtjax.errors import InputError
from vggtjax.method.fusion.rule import scale_between
from vggtjax.method.mask import dynamic_pixels, dynamic_tokens, mine_mask
from vggtjax.method.passes import motion_saliency
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.results.result import FieldOfViewWarning

FRAMES, SIZE = 4, (140, 140)

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")  # seeded weights give odd cameras


@pytest.fixture(scope="module")
def images():
    pixels = np.round(255 * seeded_images(FRAMES, *SIZE, seed=5)).astype(np.uint8)  # a clip has 8 bits
    return pixels.transpose(0, 2, 3, 1)[None].astype(np.float32) / 255


@pytest.fixture(scope="module")
def inferred(params, config, images):
    return infer(params, images, config)


def test_the_mask_is_mined_from_the_first_pass(params, config, images, inferred):
    _, passes = inferred
    saliency = jax.jit(motion_saliency, static_argnames="config")(params, images, config)
    assert np.allclose(passes.saliency, saliency, atol=1e-4)
    assert saliency.shape == (1, FRAMES, 10, 10)
    mask = jax.jit(dynamic_pixels, static_argnames="size")(passes.saliency, SIZE)
    assert (np.asarray(passes.dynamic_mask) == np.asarray(mask)).all()
    assert 0 < np.asarray(passes.dynamic_mask).mean() < 1


def test_the_second_pass_is_the_masked_forward(params, config, images, inferred):
    _, passes = inferred
    tokens = dynamic_tokens(passes.dynamic_mask, config.patch_size)
    made = jax.jit(forward, static_argnames="config")(params, images, config, dynamic_tokens=tokens)
    assert np.abs(np.asarray(passes.second.pose_encoding - made.pose_encoding)).max() < 1e-4
    assert not np.allclose(passes.first.pose_encoding, made.pose_encoding, atol=1e-3)


def test_every_method_takes_what_the_table_says(inferred):
    _, passes = inferred
    first, second = passes.first, passes.second
    cameras = {"first": decode_pose(first.pose_encoding, SIZE), "second": decode_pose(second.pose_encoding, SIZE)}
    fused = fuse_depth(first.depth, first.depth_confidence, second.depth, second.depth_confidence, passes.dynamic_mask)
    replaced = tuple(
        np.where(passes.dynamic_mask, a, b)
        for a, b in ((first.depth, second.depth), (first.depth_confidence, second.depth_confidence))
    )
    expected = {
        "vggt": ((first.depth, first.depth_confidence), "first"),
        "vggt4d": ((first.depth, first.depth_confidence), ("second", "first")),
        "pose-decoupling": ((second.depth, second.depth_confidence), "second"),
        "hard-replacement": (replaced, "second"),
        "4dvggt-d": (fused, "second"),
        "4dvggt-m": (fused, "second"),
    }
    assert set(expected) == set(METHODS)
    for method, ((depth, confidence), camera) in expected.items():
        extrinsics, intrinsics = (camera, camera) if isinstance(camera, str) else camera
        made = assemble(passes, method=method)
        assert np.allclose(made.depth, depth, rtol=1e-6), method
        assert np.allclose(made.confidence, confidence, rtol=1e-6), method
        assert np.allclose(made.camera_from_world, cameras[extrinsics][0]), method
        assert np.allclose(made.intrinsics, cameras[intrinsics][1]), method


def test_aligning_the_scale_moves_depth_and_cameras_together(inferred):
    _, passes = inferred
    scale = np.asarray(scale_between(passes.first.depth, passes.second.depth, passes.dynamic_mask))
    plain, aligned = (assemble(passes, method="pose-decoupling", align_scale=on) for on in (False, True))
    assert np.allclose(aligned.depth, plain.depth * scale[:, None, None, None], rtol=1e-5)
    assert np.allclose(
        aligned.camera_from_world[..., 3], plain.camera_from_world[..., 3] * scale[:, None, None], rtol=1e-5
    )
    assert np.allclose(aligned.camera_from_world[..., :3], plain.camera_from_world[..., :3])


def test_the_staged_pipeline_equals_the_single_jit(params, config, images, inferred):
    model = Model(config, params, "tiny")
    clip = load_clip(images[0], size=140)
    whole, passes = inferred
    seen = []

    @contextmanager
    def on_stage(name):
        seen.append(name)
        yield

    staged = reconstruct(model, clip, on_stage=on_stage)
    assert seen == ["compile programs", "image features", "first pass", "dynamic mask", "second pass", "assemble"]
    for a, b in (
        (staged.depth, whole.depth[0]),
        (staged.depth_confidence, whole.confidence[0]),
        (staged.camera_from_world, whole.camera_from_world[0]),
        (staged.saliency, passes.saliency[0]),
    ):
        assert np.abs(a - np.asarray(b)).max() <= 1e-4 * np.asarray(b).std()
    assert (staged.dynamic_mask != np.asarray(passes.dynamic_mask[0])).mean() < 1e-3
    assert (staged.method, staged.model_name) == ("4dvggt-d", "tiny")


def test_a_single_frame_is_all_static(params, config, images):
    model = Model(config, params, "tiny")
    clip = load_clip(images[0, :1], size=140)
    made = reconstruct(model, clip)
    assert not made.dynamic_mask.any()
    assert made.saliency is not None
    assert not made.saliency.any()
    assert np.isfinite(made.depth).all()


@pytest.mark.proof
def test_a_clip_of_another_size_is_refitted(params, config, images):
    model = Model(config, params, "tiny")
    fitted = reconstruct(model, load_clip(images[0], size=140))
    refitted = reconstruct(model, load_clip(images[0], size=518))
    assert refitted.depth.shape == (FRAMES, 140, 140)
    assert (refitted.depth == fitted.depth).all()


def test_options_and_masks_decide_what_the_passes_are():
    model, images = tiny_model(), jnp.zeros((1, 3, 28, 28, 3))
    run = partial(run_passes, model.params, images, model.config)
    assert jax.eval_shape(partial(run, Options(method="vggt"))).second is None
    unmoved = run(masks=False)
    assert unmoved.second is unmoved.first
    assert not unmoved.dynamic_mask.any()
    with pytest.raises(InputError, match="method is 'vgtt'; expected one of vggt, vggt4d"):
        infer(model.params, images, model.config, method="vgtt")


def test_pictures_of_another_range_are_refused(params, config, images):
    with pytest.raises(InputError, match=r"values from 0.* to 2[0-9.]*; expected RGB in \[0, 1\]: divide bytes by 255"):
        infer(params, 255 * images, config)
    with pytest.raises(InputError, match="images have type uint8"):
        infer(params, (255 * images).astype(np.uint8), config)


def test_equal_programs_are_compiled_once(params, config, images, monkeypatch):
    static = "vggtjax.pipeline.infer._infer"  # its options are static under jit
    monkeypatch.setattr(static, lambda *arguments: arguments[5])
    options = infer(params, images, config, method="vggt4d")
    assert infer(params, images, config, method="vggt4d", gram="dot", refine_mask=True) == options
    assert infer(params, images, config, method="vggt4d", align_scale=True) != options


def test_fields_of_view_beyond_a_full_turn_are_clamped_and_named(params, config, images):
    wide = jax.tree.map(lambda leaf: leaf, params)
    branch = wide["camera_head"]["pose_branch"]["fc2"]
    branch["bias"] = branch["bias"].at[7:].set(7.0 / 4)  # four iterations add it; the tangent repeats after 2 pi
    branch["kernel"] = 0.01 * branch["kernel"]
    with pytest.warns(FieldOfViewWarning, match="frames 0, 1, 2, 3 "):
        made = reconstruct(Model(config, wide), load_clip(images[0], size=140))
    assert np.allclose(2 * np.arctan(70 / made.intrinsics[:, [0, 1], [0, 1]]), 3.1, atol=1e-4)


@pytest.mark.proof
def test_the_row_of_vggt4d_is_what_is_run(params, config, images, inferred):
    _, passes = infer(params, images, config, method="vggt4d")
    saliency = jax.jit(motion_saliency, static_argnames=("config", "gram"))(params, images, config, gram="dot")
    assert np.allclose(passes.saliency, saliency, atol=1e-4)
    tokens = jax.jit(encode, static_argnames="config")(params, images, config)
    mine = jax.jit(mine_mask, static_argnames=("size", "clusters", "threshold"))
    mask = mine(saliency, tokens, SIZE, clusters=64, threshold="multi-otsu")
    assert (np.asarray(passes.dynamic_mask) == np.asarray(mask)).mean() > 0.99
    patches = dynamic_tokens(passes.dynamic_mask, config.patch_size)
    run = jax.jit(forward, static_argnames=("config", "suppress"))
    assert passes.second is not None
    made = run(params, images, config, dynamic_tokens=patches, suppress="drop")
    assert np.abs(np.asarray(passes.second.pose_encoding - made.pose_encoding)).max() < 1e-4
