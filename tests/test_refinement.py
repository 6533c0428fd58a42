"""Mask refinement on generated scenes with exact depth and cameras; golden numbers are in parity/."""

import jax
import numpy as np
import pytest

from vggtjax.refinement import refine_masks, statistical_outliers
from vggtjax.scenes import load_textures
from vggtjax.scenes.render import generate
from vggtjax.scenes.scene import SceneConfig

CONFIG = SceneConfig(height=96, width=96, frames=6, dynamic=1.0, noise=0.0, flicker=0.0, static_camera=0.0)


@pytest.fixture(scope="module")
def clip():
    clip = jax.tree.map(np.array, generate(jax.random.key(3), load_textures("training"), CONFIG))
    unit = np.median(clip.depth)  # the thresholds know VGGT's unit, in which scenes are about 1 away
    clip.camera_from_world[..., 3] /= unit
    return clip._replace(depth=clip.depth / unit)


def refined(clip, mask, **changes):
    values = {name: getattr(clip, name) for name in ("images", "depth", "camera_from_world", "intrinsics")} | changes
    return refine_masks(
        values["images"], values["depth"], mask, values["camera_from_world"], values["intrinsics"], seed=0
    )


def test_what_stands_still_leaves_the_mask_and_what_moves_stays(clip):
    coarse = clip.dynamic_mask.copy()
    coarse[:, 8:40, 8:40] = True  # a static part of the room
    made = refined(clip, coarse)
    static = coarse & ~clip.dynamic_mask
    assert (made & clip.dynamic_mask).sum() > 0.7 * clip.dynamic_mask.sum()
    assert (made & static).sum() < 0.4 * static.sum()


def test_a_right_mask_grows_by_a_pixel_or_two_at_most(clip):
    made = refined(clip, clip.dynamic_mask)
    assert (made & ~clip.dynamic_mask).sum() < 0.5 * clip.dynamic_mask.sum()


def test_empty_masks_and_single_frames_stay_as_they_are(clip):
    empty = np.zeros_like(clip.dynamic_mask)
    assert not refined(clip, empty).any()
    one = refine_masks(*(getattr(clip, name)[:1] for name in ("images", "depth")), clip.dynamic_mask[:1],
                       clip.camera_from_world[:1], clip.intrinsics[:1])  # fmt: skip
    assert np.array_equal(one, clip.dynamic_mask[:1])


def test_masks_of_a_few_pixels_in_one_frame(clip):
    few = np.zeros_like(clip.dynamic_mask)
    few[2, 50, 50:53] = True
    made = refined(clip, few)
    assert not made[[0, 1, 3, 4, 5]].any()


def test_depth_that_is_not_finite(clip):
    depth = clip.depth.copy()
    depth[0, :3] = np.inf
    depth[1, 5, 5] = np.nan
    made = refined(clip, clip.dynamic_mask, depth=depth)
    assert made.shape == depth.shape


def test_points_without_number_are_outliers():
    points = np.random.default_rng(0).normal(size=(20, 20, 3))
    points[3, 4] = np.nan
    points[5, 6] = 1e3
    found = statistical_outliers(points)
    assert found[3, 4]
    assert found[5, 6]
    assert found.sum() < 20
