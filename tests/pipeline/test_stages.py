"""Stages ahead of time, clips that are padded, passes that need not be run, and frames that are not real."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.tiny import tiny_config
from vggtjax import encode, infer, load_clip, reconstruct
from vggtjax.config import MotionConfig, VGGTConfig
from vggtjax.errors import CheckpointError, InputError
from vggtjax.method.passes import first_pass, second_pass
from vggtjax.network.backbone import ClipBatch
from vggtjax.network.checkpoint import Model
from vggtjax.network.model import init_params, parameter_shapes
from vggtjax.pipeline.fields import assembled_fields
from vggtjax.pipeline.lengths import padded_frames
from vggtjax.pipeline.run import compile_ahead
from vggtjax.pipeline.steps import Compile, Execute
from vggtjax.results.not_finite import NotFiniteWarning, warn_of_not_finite

SIDE, OFFSETS = 70, MotionConfig().offsets


@pytest.fixture(scope="module")
def model() -> Model:
    config: VGGTConfig = tiny_config(image_size=SIDE)
    return Model(config, init_params(0, config), "tiny")


def pictures(frames: int) -> np.ndarray:
    return np.random.default_rng(frames).random((frames, SIDE, SIDE, 3), np.float32)


def compilations(run) -> int:
    """How many programs jax compiles while `run` runs."""
    seen = []

    def listen(event, *_, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        run()
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return len(seen)


def apart(a, b) -> float:
    return float(np.abs(np.asarray(a) - np.asarray(b)).max() / np.asarray(b).std())


def test_lengths_are_few_and_never_an_eighth_too_long():
    lengths = [padded_frames(frames, OFFSETS) for frames in range(1, 300)]
    assert lengths[:17] == [*range(1, 17), 18]
    assert all(frames <= length <= frames * 9 / 8 for frames, length in enumerate(lengths, 1))
    assert len(set(lengths)) < 60
    assert padded_frames(17, (30,)) == 17  # frame 0 has no source among 17, but would have none among 18 either
    assert padded_frames(17, (17, -17)) == 17  # frame 0 would get one


@pytest.fixture(scope="module")
def ahead(model):
    """Return what compiling ahead says, how many programs are compiled after it, and the result."""
    shapes = Model(model.config, parameter_shapes(model.config), "no weights yet")
    needs, made = compile_ahead(shapes, 17, SIDE, SIDE), []
    late = compilations(lambda: made.append(reconstruct(model, load_clip(pictures(17), size=SIDE))))
    return needs, late, made[0]


def test_what_is_compiled_ahead_is_not_compiled_again(model, ahead):
    needs, late, _ = ahead
    assert late == 0
    assert {"image features", "first pass", "second pass"} <= needs.keys()
    assert all(need.output > 0 for need in needs.values())
    with pytest.raises(InputError, match="multiples of the patch size 14"):
        compile_ahead(model, 2, 20, 70)


def test_equal_programs_are_compiled_once():
    def scaled(x, *, factor):
        return factor * x

    compiler, counted = Compile(), []
    shape, ones = jax.ShapeDtypeStruct((3, 2), np.float32), jnp.ones((3, 2))

    def ahead():
        for name, factor in (("a", 2), ("b", 2), ("c", 3)):
            assert compiler(name, scaled)(shape, factor=factor).shape == (3, 2)
        assert compiler.wait(lambda done, count: counted.append((done, count))).keys() == {"a", "b", "c"}

    assert compilations(ahead) == 2
    assert counted == [(1, 2), (2, 2)]
    run = Execute()("d", scaled)
    assert compilations(lambda: run(ones, factor=3)) == 0
    assert (run(ones, factor=2) == 2).all()
    assert compilations(lambda: run(ones, factor=4)) == 1
    assert compilations(lambda: run(ones[:2], factor=3)) >= 1


def test_a_padded_clip_gives_the_same_and_shares_its_programs(model, ahead):
    alone = ahead[2]
    made = []

    def run(frames: int) -> int:
        clip = load_clip(pictures(frames), size=SIDE)
        return compilations(lambda: made.append(reconstruct(model, clip, pad_frames=True)))

    assert run(17) > run(18) > 0  # what cuts off the added frame
    padded = made[0]
    assert padded.depth.shape == alone.depth.shape
    assert (padded.dynamic_mask == alone.dynamic_mask).mean() > 0.999
    for name in ("depth", "depth_confidence", "saliency"):
        assert apart(getattr(padded, name), getattr(alone, name)) < 2e-4, name
    assert np.abs(padded.camera_from_world - alone.camera_from_world).max() < 1e-4


@pytest.mark.parametrize("suppress", ["zero", pytest.param("drop", marks=pytest.mark.proof)])
def test_frames_that_are_not_real_change_nothing(model, suppress):
    """Whatever they show, bit by bit."""
    config = model.config

    @jax.jit
    def passes(images, moving, count):
        clips = ClipBatch(images, encode(model.params, images, config), count)
        second = second_pass(model.params, clips, moving, config=config, suppress=suppress)
        return *first_pass(model.params, clips, config=config), second

    short = jnp.asarray(pictures(5))[None]
    moving = np.zeros((1, 7, SIDE, SIDE), bool)
    moving[:, 1:3, :28] = True
    made = []
    for rest in (np.zeros((2, SIDE, SIDE, 3)), pictures(2), np.full((2, SIDE, SIDE, 3), np.nan)):
        images = jnp.concatenate([short, jnp.asarray(rest, jnp.float32)[None]], axis=1)
        made.append(jax.tree.map(lambda x: np.asarray(x[:, :5]), passes(images, moving, jnp.array([5]))))
    for others in made[1:]:
        assert all((a == b).all() for a, b in zip(jax.tree.leaves(made[0]), jax.tree.leaves(others), strict=True))


def test_a_mask_without_a_moving_pixel_needs_no_second_pass(model):
    """The plain pass is returned as it is, which computing the second would not give: it is handed in changed."""
    images = jnp.asarray(pictures(4))[None]
    clips = ClipBatch(images, jax.jit(encode, static_argnames="config")(model.params, images, model.config))
    plain, _ = jax.jit(first_pass, static_argnames="config")(model.params, clips, config=model.config)
    assert plain.depth is not None
    marked = plain._replace(depth=plain.depth + 1)
    still, moving = np.zeros((2, 1, 4, SIDE, SIDE), bool)
    moving[0, 1] = True

    @jax.jit
    def second(mask, **more):
        return second_pass(model.params, clips, mask, config=model.config, **more)

    assert (np.asarray(second(still, plain=marked).depth) == np.asarray(marked.depth)).all()
    assert apart(second(still).depth, plain.depth) < 1e-4
    assert apart(second(moving, plain=marked).depth, second(moving).depth) < 1e-4


def test_equal_frames_show_nothing_that_moves(model):
    still = np.repeat(pictures(1), 3, axis=0)
    result = reconstruct(model, load_clip(still, size=SIDE, patch=14), size=SIDE)
    assert not result.dynamic_mask.any()
    assert result.settings["masks"] == "none: all frames are equal"
    still[2, :2, :2] = 1 - still[2, :2, :2].round()  # four pixels change, as a small mover's do
    assert reconstruct(model, load_clip(still, size=SIDE, patch=14), size=SIDE).settings["masks"] == "mined"


def test_one_program_knows_the_clips_of_a_batch_that_are_still(model):
    still = np.repeat(pictures(1), 3, axis=0)
    batch = jnp.asarray(np.stack([still, pictures(3)]))
    _, passes = infer(model.params, batch, model.config)
    assert passes.dynamic_mask[1].any()
    assert not passes.dynamic_mask[0].any()


def test_values_that_are_not_finite_are_told_once(model, monkeypatch):
    """Of 3 frames of 70 x 70 pixels, 98 pixels of one have no depth and 49 of two no confidence."""

    def spoilt(*args, **how):
        fields = assembled_fields(*args, **how)
        fields["depth"][1, :7, :14] = np.nan
        fields["depth_confidence"][1:, :7, :7] = np.inf
        return fields

    clip = load_clip(pictures(3), size=SIDE, patch=14)
    reconstruct(model, clip)  # without a warning, which would be an error
    monkeypatch.setattr("vggtjax.pipeline.run.assembled_fields", spoilt)
    with pytest.warns(NotFiniteWarning) as told:
        result = reconstruct(model, clip)
    assert [str(one.message) for one in told] == [
        "the clip: not finite are depth at 0.67% of the pixels, in 1 of 3 frames (which become no points), and "
        "depth_confidence at 0.67% of the pixels, in 2 of 3 frames (which become no points); look at these frames, or "
        "compute in float32 (precision 'highest')"
    ]
    assert result.valid_pixels.sum() == 3 * SIDE**2 - 98 - 49  # of the first, half have no depth either
    saliency = np.array(result.saliency)
    saliency[2] = np.nan
    with pytest.warns(NotFiniteWarning, match=r"saliency at 33.33% of the patches, in 1 of 3 frames \(which count as"):
        warn_of_not_finite(dataclasses.replace(result, saliency=saliency))


def test_a_parameter_that_is_not_finite_is_named(model):
    norm = model.params["camera_head"]["token_norm"]
    broken = {**model.params["camera_head"], "token_norm": {**norm, "bias": norm["bias"].at[0].set(np.nan)}}
    lost = Model(model.config, {**model.params, "camera_head": broken}, "lost")
    with pytest.raises(CheckpointError, match=r"1 of 32 values of camera_head\.token_norm\.bias of the model lost"):
        reconstruct(lost, load_clip(pictures(3), size=SIDE, patch=14), size=SIDE)
