"""Objects of a mask, by hand, on generated scenes, and against scikit-image's labels."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from skimage.measure import label

from vggtjax.errors import InputError
from vggtjax.results.instances import find_instances


def boxes(*tracks, frames=5, size=(24, 90)) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (row, column, height, width, columns a frame); returns the mask and each box's pixels."""
    each = np.zeros((len(tracks), frames, *size), bool)
    for track, (row, column, height, width, speed) in zip(each, tracks, strict=True):
        for frame in range(frames):
            left = column + speed * frame
            track[frame, row : row + height, left : left + width] = True
    return np.asarray(each.any(axis=0)), each


STANDS, WALKS = (2, 4, 6, 10, 0), (12, 2, 4, 5, 3)


def test_two_objects_keep_their_ids():
    mask, (stands, walks) = boxes(STANDS, WALKS)
    ids = find_instances(mask)
    assert ids.dtype == np.uint8
    np.testing.assert_array_equal(ids, np.where(stands, 1, np.where(walks, 2, 0)))


@pytest.mark.parametrize("speed", [3, 10])
def test_cars_in_a_row_are_not_each_other(speed):
    mask, (rear, front) = boxes((5, 2, 8, 8, speed), (5, 14, 8, 8, speed), frames=4)
    ids = find_instances(mask)
    assert ids.max() == 2
    assert len(np.unique(ids[rear])) == len(np.unique(ids[front])) == 1
    assert ids[rear][0] != ids[front][0]


@pytest.mark.parametrize(("gap", "objects"), [(0, 3), (1, 2)])
def test_an_object_that_is_lost_for_a_frame(gap, objects):
    mask, (_, walks) = boxes(STANDS, WALKS)
    mask[2] &= ~walks[2]
    ids = find_instances(mask, gap=gap)
    assert ids.max() == objects
    assert not ids[2][walks[2]].any()


def test_an_object_that_falls_apart_is_one_still():
    mask, _ = boxes((4, 2, 8, 12, 3))
    mask[3, :, 17] = False  # a crack
    ids = find_instances(mask)
    assert ids.max() == 1
    assert (ids > 0).sum() == mask.sum()


def test_what_is_too_small_is_no_object():
    mask, _ = boxes(STANDS, WALKS)
    mask[1, 20, 80] = True
    assert find_instances(mask, least_share=0).max() == 3
    ids = find_instances(mask, least_share=2 / mask[0].size)
    assert ids.max() == 2
    assert ids[1, 20, 80] == 0


def test_the_largest_of_many_are_kept():
    mask = np.zeros((1, 64, 64), bool)
    mask[0, ::2, ::2] = True  # 1024 objects of a pixel
    mask[0, 60:62, 60:62] = True  # joins its neighbours
    ids = find_instances(mask, least_share=0)
    assert np.array_equal(np.unique(ids), np.arange(256))
    assert ids[0, 60, 60] == 1


@given(st.integers(0, 10**6), st.floats(0.05, 0.6))
@settings(max_examples=30)
def test_of_one_frame_they_are_scikit_images_labels(seed, share):
    mask = np.random.default_rng(seed).random((1, 6, 9)) < share
    ids, labels = find_instances(mask, least_share=0), np.array(label(mask[0], connectivity=2))
    pairs = {(int(a), int(b)) for a, b in zip(ids.ravel(), labels.ravel(), strict=True)}
    assert len(pairs) == len(np.unique(ids)) == len(np.unique(labels))  # one to one
    assert (np.diff(np.bincount(ids.ravel())[1:]) <= 0).all()


@given(st.integers(0, 10**6), st.integers(1, 5), st.floats(0, 0.7), st.integers(0, 2))
@settings(max_examples=30)
def test_all_that_moves_and_nothing_else_has_an_id(seed, frames, share, gap):
    mask = np.random.default_rng(seed).random((frames, 7, 8)) < share
    ids = find_instances(mask, gap=gap, least_share=0)
    np.testing.assert_array_equal(ids > 0, mask)
    assert len(np.setdiff1d(np.arange(ids.max() + 1), ids)) <= (ids > 0).all()  # numbered from 1 without a gap


RIDER, SCOOTER, BOX = (1, 8, 8, 6, 3), (10, 4, 8, 14, 3), (4, 15, 5, 6, 3)


def test_parts_that_touch_and_keep_their_places_are_one_object():
    mask, _ = boxes(RIDER, SCOOTER, BOX, frames=8)
    assert find_instances(mask).max() == 1


def test_a_part_that_is_hidden_for_a_frame_is_the_object_again():
    mask, (rider, _, box) = boxes(RIDER, SCOOTER, BOX, frames=8)
    mask[3] &= ~rider[3]
    mask[5] &= ~box[5]
    ids = find_instances(mask)
    assert ids.max() == 1
    np.testing.assert_array_equal(ids > 0, mask)


def test_parts_that_are_one_region_at_times_are_one_object():
    mask, _ = boxes(RIDER, SCOOTER, frames=8)
    mask[2:5] = ndimage.binary_closing(mask[2:5], np.ones((1, 3, 3), bool))
    regions: Any = label(mask[3], connectivity=2)
    assert regions.max() == 1
    assert find_instances(mask).max() == 1


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((4, 2, 8, 8, 5), (11, 40, 8, 8, -5)),  # they pass, and are one region in two frames
        ((4, 4, 6, 16, 0), (11, 1, 6, 8, 2)),  # one walks along the other
        ((4, 4, 6, 16, 0), (10, 30, 6, 8, -2)),  # one comes near, and they are one region from then on
        ((4, 4, 8, 8, 1), (4, 12, 8, 8, 3)),  # they part
    ],
)
def test_objects_that_touch_and_move_differently_are_two(one, other):
    mask, _ = boxes(one, other, frames=7)
    ids = find_instances(mask)
    assert ids.max() == 2
    assert set(np.unique(ids[-1][mask[-1]])) == {1, 2}


def test_neighbours_that_move_alike_but_do_not_touch_are_two():
    mask, _ = boxes((2, 2, 6, 8, 3), (14, 2, 6, 8, 3), frames=8)
    assert find_instances(mask).max() == 2


def world_of(each, depths) -> np.ndarray:
    """Points of a camera that looks at boxes at a depth of their own in every frame, NaN elsewhere."""
    frames, height, width = each.shape[1:]
    rows, columns = np.indices((height, width))
    points = np.full((frames, height, width, 3), np.nan, np.float32)
    for box, depth in zip(each, depths, strict=True):
        for frame, inside in enumerate(box):
            z = np.broadcast_to(depth, frames)[frame]
            points[frame, inside] = (np.stack([columns, rows, np.full_like(rows, 50)], axis=-1) * z / 50)[inside]
    return points


@pytest.mark.parametrize(
    ("depths", "objects"),
    [
        ((2, 2), 1),
        ((2, 3), 2),  # one is behind the other
        ((2, np.linspace(2, 2.6, 8)), 2),  # one goes away from the camera
    ],
)
def test_motion_is_compared_in_the_world(depths, objects):
    mask, each = boxes((1, 8, 8, 6, 3), (10, 8, 8, 6, 3), frames=8)
    assert find_instances(mask, world_of(each, depths)).max() == objects


def test_wrong_arguments():
    with pytest.raises(InputError, match=r"dynamic_mask is float64 \(2, 3\); expected bool \[S, H, W\]"):
        find_instances(np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"gap is -1 and least_share 0\.1"):
        find_instances(np.zeros((1, 2, 3), bool), gap=-1, least_share=0.1)
