"""Ground truth at the pixels of a clip: the same resize and crop as the images, nothing averaged."""

import numpy as np
import pytest

from vggtjax.clips.clip import load_clip
from vggtjax.clips.truth import Truth, at_clip_pixels, batched_truth, intrinsics_at_clip_pixels
from vggtjax.errors import InputError


def gradient_clip(height, width, **options):
    """A clip whose red is x and whose green is y of the source, and the maps that say the same."""
    y, x = np.mgrid[0:height, 0:width]
    frame = np.stack([(x + 0.5) / width, (y + 0.5) / height, np.zeros((height, width))], axis=-1)
    return load_clip([frame, frame], **options), np.stack([x, x]), np.stack([y, y])


@pytest.mark.parametrize(("mode", "size"), [("pad", (60, 90)), ("crop", (131, 53))])
def test_maps_land_where_the_images_do(mode, size):
    clip, x, y = gradient_clip(*size, mode=mode, size=56, patch=14)
    left, top, right, bottom = clip.valid_box[0]
    for maps, channel, span in ((x, 0, size[1]), (y, 1, size[0])):
        found = at_clip_pixels(clip, maps)
        assert found.shape == clip.images.shape[:3]
        shown = clip.images[..., channel] * span - 0.5
        inside = (slice(None), slice(top + 2, bottom - 2), slice(left + 2, right - 2))  # the resize blurs the border
        assert np.abs(found[inside] - shown[inside]).max() < 0.5 + span / 255 + 0.1
        padding = np.ones(found.shape, bool)
        padding[:, top:bottom, left:right] = False
        assert not found[padding].any()


def test_a_mask_stays_a_mask_and_a_clip_of_the_same_size_stays_itself():
    clip, x, _ = gradient_clip(28, 42, size=42, patch=14)
    assert (at_clip_pixels(clip, x) == x).all()
    assert at_clip_pixels(clip, x > 9).dtype == bool
    with pytest.raises(InputError, match=r"expected 2 of the source's size \(28, 42\)"):
        at_clip_pixels(clip, x[:, :14])


def test_intrinsics_follow_the_pixels():
    clip, _, _ = gradient_clip(140, 70, size=56, patch=14)  # 112 rows, of which 28 go above and 28 below
    intrinsics = np.array([[100.0, 2, 35], [0, 110, 70], [0, 0, 1]])
    found = intrinsics_at_clip_pixels(clip, intrinsics)
    assert found.shape == (2, 3, 3)
    assert np.allclose(found[0], [[80, 1.6, 28], [0, 88, 28], [0, 0, 1]])
    point = np.array([0.2, -0.1, 2])
    seen = (intrinsics @ point)[:2] / point[2]
    assert np.allclose((found[1] @ point)[:2] / point[2], clip.from_source(1, seen))


def test_truth_gets_a_batch_axis_and_is_checked():
    maps = np.zeros((2, 4, 6, 3)), np.ones((2, 4, 6)), np.zeros((2, 4, 6), bool)
    truth = Truth(*maps, np.zeros((2, 3, 4)), np.zeros((2, 3, 3)))
    batch = batched_truth(truth)
    assert [array.shape[:2] for array in batch] == [(1, 2)] * 5
    assert batched_truth(batch).depth.shape == (1, 2, 4, 6)
    for change, sentence in (
        ({"depth": np.ones((2, 4, 5))}, r"depth has shape \(1, 2, 4, 5\); expected \(1, 2, 4, 6\)"),
        ({"dynamic_mask": np.zeros((2, 4, 6))}, "dynamic_mask has type float64; expected bool"),
    ):
        with pytest.raises(InputError, match=sentence):
            batched_truth(truth._replace(**change))
