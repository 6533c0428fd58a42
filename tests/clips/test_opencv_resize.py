"""Frames fitted as Depth Anything 3's public loader fits them (tests/golden/da3/preprocess.npz)."""

import numpy as np
import pytest
from PIL import Image

from tests.shared.da3 import TINY
from vggtjax import load_clip
from vggtjax.clips.preprocessing import Fitter, Framing
from vggtjax.config import DA3, vggt_1b
from vggtjax.errors import ClipError


@pytest.fixture(scope="module")
def arrays(golden):
    """Return what the public loader made, by name."""
    with np.load(golden / "da3/preprocess.npz") as file:
        return dict(file)


@pytest.mark.parametrize("name", ["landscape", "portrait", "small", "exact"])
def test_pictures_and_intrinsics(arrays, name):
    clip = load_clip([Image.fromarray(arrays[f"{name}/input"])], mode="fit", size=126)
    expected = arrays[f"{name}/upper_bound_resize"].transpose(1, 2, 0)
    off = np.abs(np.rint(clip.images[0] * 255) - expected)
    assert off.max() <= 1  # in 8 bits: OpenCV's cubics of a processor differ from another's
    assert (off > 0).mean() < 1e-3
    scale = clip.source_scale[0]
    for row in range(2):
        made = arrays[f"{name}/input_intrinsics"][row] / scale[row]
        np.testing.assert_allclose(made, arrays[f"{name}/upper_bound_resize_intrinsics"][row], rtol=1e-5)


def test_sizes(arrays):
    rows = arrays["sizes_504"]
    rows = rows[rows[:, 2] == 0]
    assert len(rows) > 5
    for width, height, _, *expected in rows.tolist():
        if min(expected) == 0:
            with pytest.raises(ClipError, match="cut it to a less extreme shape"):
                Fitter("fit", 504).fit(width, height, "a.png")
        else:
            assert list(Fitter("fit", 504).fit(width, height, "a.png").frame_size) == expected, (width, height)


def test_the_family_chooses_how_frames_are_fitted():
    assert Framing().fitter(DA3["da3-small"]) == Fitter("fit", 504, 14)
    assert Framing("crop").fitter(DA3["da3-small"]) == Fitter("crop", 504, 14)
    assert Framing().fitter(TINY) == Fitter("fit", 98, 14)
    assert Framing().fitter(vggt_1b()) == Fitter("crop", 518, 14)
