"""The mask by pixels: a moving poster in a painted room, and a room where nothing moves."""

import dataclasses

import numpy as np
import pytest

from tests.pipeline.refinement.test_consistent import first_frames
from tests.shared.corner import SCALE, corner_result, make_corner, paint
from vggtjax.pipeline.refinement.pixel_mask import SOURCE, mask_by_pixels


@pytest.fixture(scope="module")
def room():
    """Return pictures, and the true cameras and depth, with a Gram saliency and matches that say nothing."""
    corner = make_corner(5, 0.7)
    pictures, result = paint(corner), corner_result(corner, degrees=0, share=0)
    images = pictures[:, 1::SCALE, 1::SCALE]
    saliency = np.full((len(pictures), 6, 8), 0.3, np.float32)
    return pictures, dataclasses.replace(result, images=images, saliency=saliency, motion=np.ones_like(saliency))


def with_poster(pictures):
    moved, mask = pictures.copy(), np.zeros(pictures.shape[:3], bool)
    poster = np.random.default_rng(5).integers(0, 255, (8, 8, 1), np.uint8).repeat(6, 0).repeat(6, 1).repeat(3, 2)
    for frame in range(len(moved)):
        left = 24 + 11 * frame
        moved[frame, 48:96, left : left + 48] = poster
        mask[frame, 48:96, left : left + 48] = True
    return moved, mask[:, 1::SCALE, 1::SCALE]


def test_what_moves_is_found(room):
    pictures, result = room
    moved, mask = with_poster(pictures)
    motion = 1 + mask.reshape(len(mask), 6, 8, 8, 8).mean(axis=(2, 4), dtype=np.float32)  # too little to tell alone
    predicted = dataclasses.replace(result, images=moved[:, 1::SCALE, 1::SCALE], motion=motion)
    assert mask_by_pixels(predicted, iter(pictures)).dynamic_mask.mean() < 0.03
    made = mask_by_pixels(predicted, iter(moved))
    assert (made.dynamic_mask & mask).sum() > 0.6 * (made.dynamic_mask | mask).sum()
    assert made.motion.shape == result.saliency.shape
    assert np.median(made.motion) == pytest.approx(1, rel=1e-5)
    assert made.settings["masks"] == SOURCE
    np.testing.assert_array_equal(made.depth, result.depth)


def test_nothing_is_found_where_nothing_moves(room):
    pictures, result = room
    assert mask_by_pixels(result, iter(pictures)).dynamic_mask.mean() < 0.03


@pytest.mark.parametrize("name", ["saliency", "motion"])
def test_the_network_has_a_say(room, name):
    pictures, result = room
    more = getattr(result, name).copy()
    more[:, 1, 1] *= 3
    there = dataclasses.replace(result, **{name: more})
    ratio = mask_by_pixels(there, iter(pictures)).motion / mask_by_pixels(result, iter(pictures)).motion
    assert (ratio[:, 1, 1] > 1.2 * ratio[:, 4, 6]).all()


def test_two_frames_equal_frames_and_masks_of_other_sources_stay(room):
    pictures, result = room
    equal = dataclasses.replace(result, images=np.repeat(result.images[:1], len(result.images), axis=0))
    for each in (first_frames(result, 2), equal, dataclasses.replace(result, motion=None)):
        assert mask_by_pixels(each, iter(pictures)) is each
