"""Metric scale: a room that is predicted at 1/4 of its size gets its size back."""

import numpy as np
import pytest

from tests.shared.room import make_room
from vggtjax.errors import InputError
from vggtjax.pipeline.known.apply import apply_known, scaled
from vggtjax.pipeline.known.given import read_known
from vggtjax.pipeline.known.options import KnownGeometry

TRUE = make_room(frames=5)
SMALL = scaled(TRUE, 0.25)


def _check(known):
    found, unit = apply_known(SMALL, read_known(known, SMALL))
    assert unit == pytest.approx(4, rel=1e-4)
    np.testing.assert_allclose(found.depth, TRUE.depth, rtol=1e-4)
    np.testing.assert_allclose(found.camera_centres, TRUE.camera_centres, atol=1e-4)
    assert found.length_unit == "metre"
    assert found.known_facts["scale"].startswith("4 metres per unit")


def test_known_depths_give_the_scale_despite_an_outlier(tmp_path):
    lines = [f"{i},{2 * x + 1},{2 * y + 1},{TRUE.depth[i, y, x]}" for i, x, y in ((0, 3, 4), (2, 8, 2), (4, 5, 9))]
    (tmp_path / "depths.csv").write_text("\n".join(["frame,x,y,depth", *lines, "1,3,3,900", ""]))
    _check(KnownGeometry(known_depths=str(tmp_path / "depths.csv")))


def test_a_baseline_gives_the_scale():
    metres = np.linalg.norm(TRUE.camera_centres[1] - TRUE.camera_centres[4])
    _check(KnownGeometry(baseline=f"1,4,{metres}"))
    still = make_room(frames=5, camera_from_world=np.tile(SMALL.camera_from_world[:1], (5, 1, 1)))
    with pytest.raises(InputError, match=r"frames 0 and 2 are predicted .* median depths apart, which is no motion"):
        apply_known(still, read_known(KnownGeometry(baseline="0,2,1"), still))


def _over_a_floor():
    """Return level cameras 1.6 above a floor that fills the lower half of the picture; the rest is 20 away."""
    poses = np.tile(np.eye(3, 4), (5, 1, 1))
    poses[:, 0, 3] = -np.arange(5) / 5
    y = (np.arange(28) + 0.5 - 14) / TRUE.intrinsics[0, 1, 1]
    depth = np.where(y > 0.08, 1.6 / np.maximum(y, 0.08), 20)[None, :, None] + np.zeros(TRUE.depth.shape)
    return make_room(frames=5, camera_from_world=poses, depth=depth, dynamic_mask=np.zeros(depth.shape, bool))


def test_the_height_above_the_floor_gives_the_scale():
    true, known = _over_a_floor(), KnownGeometry(camera_height=1.6)
    small = scaled(true, 0.25)
    found, unit = apply_known(small, read_known(known, small))
    assert unit == pytest.approx(4, rel=1e-5)
    np.testing.assert_allclose(found.depth, true.depth, rtol=1e-5)
    with pytest.raises(InputError, match="finds no floor"):
        apply_known(TRUE, read_known(known, TRUE))  # it shows a wall


def test_depths_that_do_not_fit_are_refused(tmp_path):
    for text, message in (
        ("frame,x,y\n0,1,1\n", "line 2 is .* expected columns frame, x, y and depth"),
        ("frame,x,y,depth\n9,1,1,1\n", "line 2 is .* a frame of 0 to 4"),
        ("frame,x,y,depth\n0,99,1,1\n", r"line 2: \(99, 1\) lies outside .* a picture of 84 x 56 pixels"),
    ):
        (tmp_path / "depths.csv").write_text(text)
        with pytest.raises(InputError, match=message):
            apply_known(SMALL, read_known(KnownGeometry(known_depths=str(tmp_path / "depths.csv")), SMALL))
