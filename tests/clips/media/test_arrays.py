"""Frames in memory, and values of every depth as 8 bits."""

import numpy as np
import pytest

from vggtjax.clips.media.arrays import ArrayFrames, eight_bit
from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import ClipError


def test_depths():
    np.testing.assert_array_equal(
        eight_bit(np.array([0, 128, 129, 385, 386, 65406, 65407, 65535], np.uint16), "a"),
        [0, 0, 1, 1, 2, 254, 255, 255],
    )
    np.testing.assert_array_equal(eight_bit(np.array([256, 65535], ">u2"), "a"), [1, 255])
    np.testing.assert_array_equal(eight_bit(np.array([0, 0.5, 1]), "a"), [0, 128, 255])
    values = np.arange(256, dtype=np.uint8)
    for dtype in (np.float16, np.float32):  # 8 bits survive
        np.testing.assert_array_equal(eight_bit((values / 255).astype(dtype), "a"), values)


BLACK = np.zeros((4, 5, 3), np.uint8)


def test_what_is_no_frame():
    for arrays, message in (
        (np.full((1, 2, 2, 3), np.nan), "frame 000000 has values that are not finite"),
        (np.full((1, 2, 2, 3), 1.5), r"has values from 1.5 to 1.5; expected floating point in \[0, 1\]"),
        (np.ones((1, 2, 2, 3), int), "frame 000000 has values of type int64"),
        (BLACK, r"the array has shape \(4, 5, 3\); expected frames \[S, H, W, 3\]"),
        ([BLACK, BLACK[..., 0]], r"frame 000001 has shape \(4, 5\)"),
    ):
        with pytest.raises(ClipError, match=message):
            list(ArrayFrames.from_arrays(arrays).frames(Sampling()))


def test_colours_first_and_batches_are_named_with_the_remedy():
    with pytest.raises(ClipError, match=r"colours first; .*: array\.transpose\(0, 2, 3, 1\), or tensor\.permute"):
        ArrayFrames.from_arrays(np.zeros((4, 3, 28, 42), np.float32))
    with pytest.raises(ClipError, match=r"shape \(1, 4, 28, 42, 3\); give the clips of a batch one by one"):
        ArrayFrames.from_arrays(np.zeros((1, 4, 28, 42, 3), np.float32))


def test_frames_are_named_by_their_index_in_the_source():
    arrays = (np.arange(5, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 3, 3), np.uint8))[:, :, ::-1]
    source = ArrayFrames.from_arrays(arrays)
    sampling = Sampling(start=1, stride=2)
    frames = list(source.frames(sampling))
    assert source.total(sampling) == 2
    assert [frame.name for frame in frames] == ["000001", "000003"]
    assert [np.asarray(frame.image)[0, 0, 0] for frame in frames] == [1, 3]
    assert all(frame.time is None and frame.image.mode == "RGB" and frame.image.size == (3, 2) for frame in frames)


def test_bytes_in_16_bits_are_refused_and_dark_frames_of_16_bits_are_not():
    values = np.arange(4 * 5 * 6 * 3).reshape(4, 5, 6, 3) % 256
    for arrays in (values.astype(np.uint16), list(values.astype(">u2"))):
        with pytest.raises(ClipError, match=r"uint16 and have no value above 255, .*; give array\.astype\(np\.uint8\)"):
            ArrayFrames.from_arrays(arrays)
    values[3, 0, 0, 0] = 256
    assert len(ArrayFrames.from_arrays(values.astype(np.uint16)).arrays) == 4
