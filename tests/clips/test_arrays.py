"""Frames in memory, and values of every depth as 8 bits."""

import numpy as np
import pytest
from PIL import Image

from vggtjax.clips.arrays import ArrayFrames, eight_bit
from vggtjax.clips.sampling import Sampling
from vggtjax.errors import ClipError


def test_depths():
    np.testing.assert_array_equal(
        eight_bit(np.array([0, 128, 129, 385, 386, 65406, 65407, 65535], np.uint16), "a"),
        [0, 0, 1, 1, 2, 254, 255, 255],
    )
    np.testing.assert_array_equal(eight_bit(np.array([256, 65535], ">u2"), "a"), [1, 255])
    np.testing.assert_array_equal(eight_bit(np.array([0, 0.5, 1]), "a"), [0, 128, 255])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_eight_bits_survive_floating_point(dtype):
    values = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(eight_bit((values / np.float64(255)).astype(dtype), "a"), values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([0.1, np.nan], "frame left has values that are not finite"),
        ([0.1, np.inf], "frame left has values that are not finite"),
        ([0.0, 1.5], r"frame left has values from 0 to 1.5; expected floating point in \[0, 1\]"),
        ([-0.5, 1.0], "frame left has values from -0.5 to 1"),
        (np.array([1, 2]), "frame left has values of type int64"),
        (np.array([True]), "frame left has values of type bool"),
    ],
)
def test_values_that_are_no_colours(values, message):
    with pytest.raises(ClipError, match=message):
        eight_bit(np.asarray(values), "left")


def test_frames_are_named_by_their_index_in_the_source():
    arrays = np.arange(5, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 3, 3), np.uint8)
    source = ArrayFrames.from_arrays(arrays)
    sampling = Sampling(start=1, stride=2)
    frames = list(source.frames(sampling))
    assert source.total(sampling) == 2
    assert [frame.name for frame in frames] == ["000001", "000003"]
    assert [np.asarray(frame.image)[0, 0, 0] for frame in frames] == [1, 3]
    assert all(frame.time is None and frame.image.mode == "RGB" and frame.image.size == (3, 2) for frame in frames)


def test_views_need_not_be_contiguous():
    array = np.arange(24, dtype=np.uint8).reshape(1, 2, 4, 3)[:, :, ::-1]
    (frame,) = ArrayFrames.from_arrays(array).frames(Sampling())
    np.testing.assert_array_equal(np.asarray(frame.image), array[0])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (np.zeros((4, 5, 3), np.uint8), r"the array has shape \(4, 5, 3\); expected frames \[S, H, W, 3\]"),
        (np.zeros((0, 4, 5, 3), np.uint8), "holds no frames"),
        (np.zeros((1, 4, 5, 1), np.uint8), r"frame 000000 has shape \(4, 5, 1\)"),
        ([np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), np.uint8)], r"frame 000001 has shape \(4, 5\)"),
        ([np.zeros((4, 0, 3), np.uint8)], "none empty"),
    ],
)
def test_shapes_that_are_no_frames(arrays, message):
    with pytest.raises(ClipError, match=message):
        ArrayFrames.from_arrays(arrays)


def test_an_image_is_not_changed_by_its_way_through_pillow():
    array = np.random.default_rng(0).integers(0, 256, (1, 4, 5, 3), np.uint8)
    (frame,) = ArrayFrames.from_arrays(array).frames(Sampling())
    assert isinstance(frame.image, Image.Image)
    np.testing.assert_array_equal(np.asarray(frame.image), array[0])
