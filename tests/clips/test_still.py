"""Frames of one picture: codecs change them and nothing moves; small and faint things that move are seen."""

from typing import Any

import av
import numpy as np
import PIL.Image
import pytest

from tests.shared.videos import encode
from vggtjax import load_clip
from vggtjax.clips.still import same_picture
from vggtjax.pipeline.pretrained.embedded import demo_clip

OLD_ROUNDING = 2 / 255
GREY = np.full((84, 98, 3), 100 / 255, np.float32)


def photo():
    picture = PIL.Image.fromarray(np.rint(255 * demo_clip().images[0]).astype(np.uint8))
    return np.asarray(picture.resize((280, 280)))


def changed(rows, columns, amount, channels=slice(None)):
    other = GREY.copy()
    other[rows, columns, channels] += amount / 255
    return other


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_a_photo_as_a_video_is_still(tmp_path, codec):
    if codec not in av.codecs_available:
        pytest.skip(f"FFmpeg here has no {codec}")
    how: Any = {"crf": "23"} if codec == "libx264" else {"bits": 2_000_000}
    clip = load_clip(encode(tmp_path / "photo.mp4", [photo()] * 8, codec, **how), size=280, patch=14)
    assert np.abs(clip.images - clip.images[0]).max() > OLD_ROUNDING
    assert clip.is_still
    for level in (0, 255):
        plain = encode(tmp_path / f"{level}.mp4", [np.full((84, 98, 3), level, np.uint8)] * 8, codec, **how)
        assert load_clip(plain, size=98, patch=14).is_still
    moving = demo_clip().images
    assert not any(same_picture(a, b) for a, b in zip(moving[1:], moving[:-1], strict=True))


def test_small_and_faint_changes_are_seen():
    """Bounds by hand: 3 x 3 pixels of 20 exceed 12, of 9 x 9 pixels 6 exceed 5, of 27 x 27 pixels 3 exceed 2.5."""
    small, middle, large = slice(40, 43), slice(40, 49), slice(40, 67)
    assert not same_picture(changed(small, small, 20), GREY)
    assert not same_picture(changed(small, small, -20, channels=slice(1)), GREY)  # above 18 in a single channel
    assert not same_picture(changed(slice(0, 3), slice(95, 98), 20), GREY)  # in a corner
    assert not same_picture(changed(middle, middle, 6), GREY)
    assert not same_picture(changed(large, large, 3), GREY)
    assert same_picture(changed(slice(40, 41), slice(40, 41), 100), GREY)  # a single pixel: 100 / 9 is below 12
    assert same_picture(changed(middle, middle, 4), GREY)
    assert same_picture(changed(large, large, 2), GREY)


def test_pictures_smaller_than_a_box_and_values_that_are_not_finite():
    tiny = GREY[:2, :2]
    assert same_picture(tiny, tiny)
    assert not same_picture(tiny + 3 / 255, tiny)
    assert not same_picture(np.full_like(GREY, np.nan), GREY)
    noise = np.random.default_rng(0).normal(0, 3 / 255, (2, *GREY.shape)).astype(np.float32)
    assert same_picture(GREY + noise[0], GREY + noise[1])  # of a camera
