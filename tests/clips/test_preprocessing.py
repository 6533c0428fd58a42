"""The geometry of crop and pad: the pixels of VGGT, placements by hand, what holds for every size; truth goes along."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from vggtjax.clips.clip import load_clip
from vggtjax.clips.media.images import to_rgb
from vggtjax.clips.media.sampling import Frame
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.truth import Truth, at_clip_pixels, batched_truth, intrinsics_at_clip_pixels
from vggtjax.errors import ClipError, InputError

GOLDEN = Path(__file__).parents[1] / "golden" / "preprocess.npz"


@pytest.mark.parametrize("mode", ["crop", "pad"])
@pytest.mark.parametrize("picture", ["landscape", "tall", "rgba", "grey"])
def test_pixels_are_those_of_vggt(picture, mode):
    with np.load(GOLDEN, allow_pickle=False) as golden:
        image = to_rgb(Image.fromarray(golden[f"{picture}/input"]), picture)
        expected = golden[f"{picture}/{mode}"].transpose(1, 2, 0)
    np.testing.assert_array_equal(Fitter(mode).fit(*image.size, picture).render(Frame("", image)), expected)


def test_pad_puts_the_odd_rest_below():
    # 40 x 10 at size 15, patch 3: round(10 * 0.375 / 3) * 3 = 3 high, 12 rows of white: 6 above, 6 below.
    assert Fitter("pad", 15, 3).fit(40, 10, "a").box == (0, 6, 15, 9)
    # 40 x 15: round(15 * 0.375 / 3) * 3 = 6 high, 9 rows of white: 4 above, 5 below.
    assert Fitter("pad", 15, 3).fit(40, 15, "a").box == (0, 4, 15, 10)
    assert Fitter("pad", 15, 3).fit(15, 40, "a").box == (4, 0, 10, 15)


@given(
    sides=st.tuples(st.integers(20, 400), st.integers(20, 400)),
    patches=st.integers(8, 20),
    patch=st.integers(1, 16),
    mode=st.sampled_from(["crop", "pad"]),
)
def test_every_fit(sides, patches, patch, mode):
    size = patches * patch
    if round(min(sides) * size / max(sides) / patch) < 1:
        return
    fit = Fitter(mode, size, patch).fit(sides[0], sides[1], "a")
    left, top, right, bottom = fit.box
    assert fit.frame_size[0] == size
    assert fit.frame_size[1] <= size if mode == "crop" else fit.frame_size[1] == size
    assert (right - left) % patch == 0 == (bottom - top) % patch
    for axis, (first, last) in enumerate(((left, right), (top, bottom))):
        assert 0 <= first < last <= fit.frame_size[axis]
        first, last = (fit.scale[axis] * edge + fit.offset[axis] for edge in (first, last))
        assert -1e-9 <= first < last <= sides[axis] + 1e-9
        assert np.isclose(first + last, sides[axis], atol=fit.scale[axis])  # centred, up to a pixel of an odd rest


def test_pictures_that_do_not_fit():
    with pytest.raises(ClipError, match="frame strip is 1000 x 3, which becomes 518 x 0"):
        Fitter("pad").fit(1000, 3, "strip")
    with pytest.raises(ClipError, match=r"frame tower is 1 x 10000.*a less extreme shape"):
        Fitter("crop").fit(1, 10000, "tower")
    with pytest.raises(ClipError, match=r"which becomes 100002 x 100002 .*; choose a smaller size"):
        Fitter("crop", 100002).fit(64, 64, "a")
    with pytest.raises(InputError, match="mode is 'stretch'"):
        Fitter("stretch")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="size is 520; expected a multiple of patch 14"):
        Fitter(size=520)


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
