"""Mask refinement on generated scenes with exact depth and cameras; golden numbers are in parity/."""

from typing import Any

import jax
import numpy as np
import pytest
from scipy import ndimage

from vggtjax.errors import InputError
from vggtjax.method import mask_refinement
from vggtjax.method.mask_refinement import refine_masks
from vggtjax.training.scenes import load_textures
from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.scenes.render import generate

CONFIG = SceneConfig(height=96, width=96, frames=6, dynamic=1.0, noise=0.0, flicker=0.0, static_camera=0.0)


@pytest.fixture(scope="module")
def clip():
    draw = jax.jit(generate, static_argnames="config")
    clip = jax.tree.map(np.array, draw(jax.random.key(3), load_textures("training"), config=CONFIG))
    unit = np.median(clip.depth)  # the thresholds know VGGT's unit, in which scenes are about 1 away
    clip.camera_from_world[..., 3] /= unit
    return clip._replace(depth=clip.depth / unit)


def refined(clip, mask, *, valid=None, **changes):
    images, depth, poses, intrinsics = (
        changes.get(name, getattr(clip, name)) for name in ("images", "depth", "camera_from_world", "intrinsics")
    )
    return refine_masks(images, depth, mask, poses, intrinsics, valid=valid, seed=0)


def test_what_stands_still_leaves_the_mask_and_what_moves_stays(clip):
    coarse = clip.dynamic_mask.copy()
    coarse[2, 8:40, 8:40] = True  # a static part of the room, which the other frames can vouch for
    made = refined(clip, coarse)
    static = coarse & ~clip.dynamic_mask
    assert (made & clip.dynamic_mask).sum() > 0.7 * clip.dynamic_mask.sum()
    assert (made & static).sum() < 0.4 * static.sum()


def test_a_right_mask_grows_by_a_pixel_or_two_at_most(clip):
    made = refined(clip, clip.dynamic_mask)
    for mask, one in zip(clip.dynamic_mask, made, strict=True):
        near = ndimage.binary_dilation(mask, np.ones((7, 7)))
        assert not one[np.logical_not(near)].any()


def test_empty_masks_and_single_frames_stay_as_they_are(clip):
    empty = np.zeros_like(clip.dynamic_mask)
    assert not refined(clip, empty).any()
    first = jax.tree.map(lambda leaf: leaf[:1], clip)
    assert np.array_equal(refined(first, first.dynamic_mask), first.dynamic_mask)


def test_a_mask_of_outliers_alone_is_empty(clip):
    depth, one = clip.depth.copy(), np.zeros_like(clip.dynamic_mask)
    one[1, 40, 40] = True
    depth[1, 40, 40] *= 100
    assert not refined(clip, one, depth=depth).any()
    depth[clip.dynamic_mask] = np.nan
    assert not refined(clip, clip.dynamic_mask, depth=depth).any()


def test_padding_is_no_witness(clip):
    valid = np.ones_like(clip.dynamic_mask)
    valid[:, :, :20] = False
    depth, images = clip.depth.copy(), clip.images.copy()
    depth[~valid], images[~valid] = 0.5, 1.0  # what padding says must not matter
    coarse = clip.dynamic_mask.copy()
    coarse[:, 8:40, 10:40] = True
    made = refined(clip, coarse, images=images, depth=depth, valid=valid)
    assert not made[~valid].any()
    assert np.array_equal(made, refined(clip, coarse, valid=valid))


@pytest.mark.proof
def test_large_masks_are_grouped_by_a_part_of_their_points(clip, monkeypatch):
    coarse = clip.dynamic_mask.copy()
    coarse[:, 8:60, 8:60] = True
    whole = refined(clip, coarse)
    jitted: Any = mask_refinement.cluster_points
    monkeypatch.setattr(mask_refinement, "FITTED", 500)
    jitted.clear_cache()
    part = refined(clip, coarse)
    jitted.clear_cache()
    assert (whole & part).sum() / (whole | part).sum() > 0.7


@pytest.mark.parametrize("name", ["depth", "mask"])
def test_arrays_that_do_not_fit(clip, name):
    mask = clip.dynamic_mask.astype(np.uint8) * 255 if name == "mask" else clip.dynamic_mask
    changes = {} if name == "mask" else {name: getattr(clip, name)[:2]}
    with pytest.raises(InputError, match="expected"):
        refined(clip, mask, **changes)
