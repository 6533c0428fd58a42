"""Loading a clip from every kind of source, and the way from its pixels back to the source's."""

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.shared.tiny import tiny_model
from vggtjax.clips.clip import load_clip
from vggtjax.errors import ClipError, InputError
from vggtjax.pipeline.inputs import read_inputs
from vggtjax.progress import no_stage

GREY = 100


def frames(*sizes):
    """Grey frames of (width, height)."""
    return [np.full((height, width, 3), GREY, np.uint8) for width, height in sizes]


def test_a_clip_by_hand():
    clip = load_clip(frames((40, 20), (40, 20), (40, 20)), size=28, stride=2)
    assert clip.images.shape == (2, 14, 28, 3)
    assert clip.images.dtype == np.float32
    assert (clip.images == np.float32(GREY) / np.float32(255)).all()
    assert clip.frame_names == ["000000", "000002"]
    assert clip.timestamps is None
    np.testing.assert_array_equal(clip.source_size, [[20, 40]] * 2)
    np.testing.assert_array_equal(clip.source_scale, [[40 / 28, 20 / 14]] * 2)
    np.testing.assert_array_equal(clip.source_offset, [[0, 0]] * 2)
    np.testing.assert_array_equal(clip.valid_box, [[0, 0, 28, 14]] * 2)
    np.testing.assert_allclose(clip.to_source(0, np.array([14.0, 7.0])), [20, 10])
    np.testing.assert_allclose(clip.from_source(1, np.array([[0, 0], [40, 20]])), [[0, 0], [28, 14]])


def test_a_clip_for_a_model():
    model, arrays = tiny_model(image_size=56, patch_size=8), frames((40, 20))
    clip = load_clip(arrays, model=model)
    read = read_inputs(model, arrays, size=None, masks=None, tracks=None, known=None, on_stage=no_stage).clip
    for each in (clip, read):  # as `reconstruct` loads it
        assert (each.size, each.patch, each.images.shape) == (56, 8, (1, 32, 56, 3))
    padded = load_clip(arrays, model=model, size=32, mode="pad", patch=8)
    assert padded.images.shape == (1, 32, 32, 3)
    with pytest.raises(InputError, match="patch is 14; leave it out, as the model's patch size is 8"):
        load_clip(frames((40, 20)), model=model, patch=14)
    with pytest.raises(InputError, match="size is 28; expected a multiple of patch 8"):
        load_clip(frames((40, 20)), model=model, size=28)
    with pytest.raises(InputError, match="model is 'demo'; expected what load_model returned"):
        load_clip(frames((40, 20)), model="demo")  # pyright: ignore[reportArgumentType]


def test_frames_of_different_sizes_are_padded_with_white(caplog):
    with caplog.at_level(logging.WARNING):
        clip = load_clip(frames((40, 20), (30, 36)), size=28, patch=7)
    assert clip.images.shape == (2, 28, 28, 3)
    # 40 x 20 becomes 28 x 14: 7 rows of white above and below. 30 x 36 becomes 28 x 35, cut by 3 above and 4 below.
    np.testing.assert_array_equal(clip.valid_box, [[0, 7, 28, 21], [0, 0, 28, 28]])
    assert (clip.images[0, :7] == 1).all()
    assert (clip.images[0, 21:] == 1).all()
    assert (clip.images[0, 7:21] < 0.5).all()
    np.testing.assert_allclose(clip.to_source(0, np.array([0.0, 7.0])), [0, 0], atol=1e-12)
    np.testing.assert_allclose(clip.to_source(1, np.array([0.0, 0.0])), [0, 3 * 36 / 35])
    assert "different sizes (28 x 14, 28 x 28); they are padded with white to 28 x 28" in caplog.text


@given(
    size=st.tuples(st.integers(20, 90), st.integers(20, 90)),
    mode=st.sampled_from(["crop", "pad"]),
    points=st.lists(st.tuples(st.floats(-500, 500), st.floats(-500, 500)), min_size=1, max_size=5),
)
def test_the_mappings_undo_each_other(size, mode, points):
    clip = load_clip(frames(size), mode=mode, size=28, patch=7)
    for there, back in ((clip.to_source, clip.from_source), (clip.from_source, clip.to_source)):
        np.testing.assert_allclose(back(0, there(0, np.array(points))), points, atol=1e-9)
    with pytest.raises(InputError, match=r"expected \(x, y\) along the last axis"):
        clip.to_source(0, np.zeros(3))
    left, top, right, bottom = clip.valid_box[0]
    corners = clip.to_source(0, np.array([[left, top], [right, bottom]]))
    assert (corners >= -1e-9).all()
    assert (corners <= np.array(size) + 1e-9).all()


def test_progress_and_order():
    seen, count = [], 9
    arrays = np.arange(count, dtype=np.uint8)[:, None, None, None] * np.ones((1, 14, 14, 3), np.uint8)
    clip = load_clip(arrays, size=14, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(done, count) for done in range(1, count + 1)]
    np.testing.assert_array_equal(np.rint(clip.images[:, 0, 0, 0] * 255), np.arange(count))


def test_refit(tmp_path):
    for index in range(4):
        Image.new("RGB", (40, 20 + 20 * index)).save(tmp_path / f"{index}.png")
    clip = load_clip(tmp_path, size=28, start=1, max_frames=1)
    again = clip.refit(32, 8)
    assert (again.frame_names, again.images.shape, again.patch) == (["1"], (1, 32, 32, 3), 8)
    np.testing.assert_array_equal(again.refit(28, 14).images, clip.images)
    assert clip.refit(28, 14, "pad").mode == "pad"
    Image.new("RGB", (10, 10)).save(tmp_path / "1.png")
    with pytest.raises(ClipError, match="other frames than before"):
        clip.refit(32, 8)
    (tmp_path / "1.png").unlink()
    with pytest.raises(ClipError, match="does not exist"):
        clip.refit(32, 8)


def test_more_frames_than_fit(monkeypatch):
    monkeypatch.setattr("vggtjax.clips.clip.MOST_BYTES", 3 * 12 * 28 * 14)
    assert len(load_clip(frames(*[(40, 20)] * 3), size=28)) == 3
    with pytest.raises(ClipError, match="more than 3 frames of 28 x 14 exceed"):
        load_clip(frames(*[(40, 20)] * 4), size=28)
    with pytest.raises(ClipError, match="frame 000001 is 900 x 2"):
        load_clip(frames((40, 20), (900, 2)), size=28)


@pytest.mark.parametrize("mode", ["crop", "pad"])
def test_floating_point_stays_as_it_is_where_nothing_is_resized(mode):
    """As `infer` takes it; beside it white, and in 8 bits where it is resized."""
    frames = np.random.default_rng(0).random((2, 28, 56, 3))
    clip = load_clip(frames, size=56, mode=mode)
    left, top, right, bottom = clip.valid_box[0]
    assert np.array_equal(clip.images[:, top:bottom, left:right], frames.astype(np.float32))
    assert (clip.images[:, :top] == 1).all()
    resized = load_clip(frames, size=28, mode=mode).images
    assert np.array_equal(resized, np.rint(resized * 255) / np.float32(255))
