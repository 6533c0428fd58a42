"""Objects of a mask, by hand and against scikit-image's labels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import label

from vggtjax.errors import InputError
from vggtjax.instances import find_instances


def two_boxes(frames=5):
    """A large box that stands, and a smaller one that walks to the right beneath it."""
    mask = np.zeros((frames, 20, 40), bool)
    mask[:, 2:8, 4:14] = True
    for frame in range(frames):
        mask[frame, 12:16, 2 + 3 * frame : 7 + 3 * frame] = True
    return mask


def test_two_objects_keep_their_ids():
    mask = two_boxes()
    ids = find_instances(mask)
    assert ids.dtype == np.uint8
    np.testing.assert_array_equal(ids > 0, mask)
    assert (ids[:, :10][mask[:, :10]] == 1).all()
    assert (ids[:, 10:][mask[:, 10:]] == 2).all()


@pytest.mark.parametrize(("gap", "objects"), [(0, 3), (1, 2)])
def test_an_object_that_is_lost_for_a_frame(gap, objects):
    mask = two_boxes()
    mask[2, :10] = False
    ids = find_instances(mask, gap=gap)
    assert ids.max() == objects
    assert not ids[2, :10].any()


def test_what_is_too_small_is_no_object():
    mask = two_boxes()
    mask[1, 18, 30] = True
    assert find_instances(mask, least_share=0).max() == 3
    ids = find_instances(mask, least_share=2 / 800)
    assert ids.max() == 2
    assert ids[1, 18, 30] == 0


def test_the_largest_of_many_are_kept():
    mask = np.zeros((1, 64, 64), bool)
    mask[0, ::2, ::2] = True  # 1024 objects of a pixel
    mask[0, 60:62, 60:62] = True  # joins its neighbours
    ids = find_instances(mask, least_share=0)
    assert np.array_equal(np.unique(ids), np.arange(256))
    assert ids[0, 60, 60] == 1


@given(st.integers(0, 10**6), st.integers(1, 4), st.floats(0.05, 0.6))
@settings(deadline=None, max_examples=30)
def test_without_a_gap_they_are_scikit_images_labels(seed, frames, share):
    mask = np.random.default_rng(seed).random((frames, 6, 9)) < share
    ids, labels = find_instances(mask, gap=0, least_share=0), np.array(label(mask, connectivity=3))
    assert len(np.unique(ids)) == len(np.unique(labels))
    pairs = {(int(a), int(b)) for a, b in zip(ids.ravel(), labels.ravel(), strict=True)}
    assert len(pairs) == len(np.unique(labels))  # one to one
    volumes = np.bincount(ids.ravel())[1:]
    assert (np.diff(volumes) <= 0).all()


def test_nothing_moves():
    assert not find_instances(np.zeros((3, 4, 5), bool)).any()


def test_wrong_arguments():
    with pytest.raises(InputError, match=r"dynamic_mask is float64 \(2, 3\); expected bool \[S, H, W\]"):
        find_instances(np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"gap is -1 and least_share 0\.1"):
        find_instances(np.zeros((1, 2, 3), bool), gap=-1, least_share=0.1)
