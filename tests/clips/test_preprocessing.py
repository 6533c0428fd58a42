"""The geometry of crop and pad: the pixels of VGGT, hand-computed placements, and what holds for every size."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from vggtjax.clips.media.images import to_rgb
from vggtjax.clips.media.sampling import Frame
from vggtjax.clips.preprocessing import Fitter
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
