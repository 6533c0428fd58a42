"""The page that all reconstructions call: who calls it, given masks, rules of one's own, and equal frames."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from tests.tiny import tiny_model
from vggtjax import Clips, Model, compile_ahead, infer, load_clip, reconstruct, reconstruct_long, write_artefact
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.evaluation.ladder import ladder
from vggtjax.learning import reconstruct_softly, soft_masking
from vggtjax.method.algorithm import run_method
from vggtjax.pipeline.batch import reconstruct_many
from vggtjax.pipeline.several import reconstruct_methods
from vggtjax.windows.plan import Windows

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
        "soft masks": lambda: reconstruct_softly(model.params, IMAGES, config, soft_masking(config)),
        "artefact": lambda: write_artefact(model, folder / "a", frames=FRAMES, height=SIDE, width=SIDE),
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
    for masks in (MASKS[:1], MASKS.astype(np.uint8)):
        with pytest.raises(InputError, match=r"expected bool, or shares as floats, of shape \(2, 4, 28, 28\)"):
            infer(model.params, IMAGES, model.config, masks=masks)


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
    with pytest.raises(InputError, match=r"arrays of shape \[\(2, 4, 28, 28\)\]; expected depth and"):
        infer(model.params, IMAGES, model.config, fusion=one_map)
    with pytest.raises(InputError, match="method 'vggt' does not fuse"):
        infer(model.params, IMAGES, model.config, fusion=one_map, method="vggt")


def test_equal_frames_have_an_empty_mask_for_every_caller(model):
    images: Any = np.stack([np.repeat(IMAGES[0, :1], FRAMES, axis=0), IMAGES[1]])
    config = model.config
    for passes in (
        infer(model.params, images, config)[1],
        reconstruct_softly(model.params, jnp.asarray(images), config, soft_masking(config)).passes,
        run_method(model.params, Clips(jnp.asarray(images)), config).passes,
    ):
        share = np.asarray(passes.dynamic_mask).mean(axis=(1, 2, 3))
        assert share[0] == 0 < share[1]
