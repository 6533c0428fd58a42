"""Several known things together, what a capture tells, and pixels that are left out."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.shared.textured_room import textured_room
from vggtjax.clips.captures.capture import Capture
from vggtjax.errors import InputError
from vggtjax.pipeline.known.apply import apply_known, scaled
from vggtjax.pipeline.known.given import read_known
from vggtjax.pipeline.known.options import KnownGeometry

TRUE = textured_room(4)
SOURCE_K = TRUE.intrinsics * np.array([[2], [2], [1]])  # its source has twice its pixels


def _capture(**changes):
    """Return what an app recorded of the room, with depth at half of the result's pixels."""
    fields = {
        "kind": "polycam",
        "path": Path("capture"),
        "pictures": tuple(Path(f"{name}.jpg") for name in TRUE.frame_names),
        "sizes": ((168, 112),) * 4,
        "metric": True,
    }
    capture = Capture(**(fields | changes))
    capture.__dict__["frame_names"] = TRUE.frame_names
    return capture


def test_intrinsics_poses_and_depth_come_from_the_source():
    known = KnownGeometry(intrinsics="source", poses="source", known_depths="source")
    maps = {Path(f"{frame}.npy"): TRUE.depth[frame, ::2, ::2] for frame in range(4)}
    capture = _capture(
        intrinsics=SOURCE_K.astype(np.float64),
        world_from_camera=TRUE.world_from_camera.astype(np.float64),
        depth_files=tuple(maps),
        read_depth_file=maps.__getitem__,
    )
    found, unit = apply_known(scaled(TRUE, 0.5), read_known(known, scaled(TRUE, 0.5), capture=capture))
    np.testing.assert_allclose(found.depth, TRUE.depth, rtol=1e-3)
    np.testing.assert_allclose(found.camera_from_world, TRUE.camera_from_world, atol=1e-3)
    assert unit == pytest.approx(2, rel=1e-3)
    assert found.length_unit == "metre"
    assert set(found.known_facts) == {"intrinsics", "poses", "depth by poses", "scale"}


@pytest.mark.parametrize(
    ("name", "message"), [("intrinsics", "no intrinsics"), ("poses", "no poses"), ("known_depths", "no depth maps")]
)
def test_a_capture_that_lacks_something_is_refused(name, message):
    known: dict[str, Any] = {name: "source"}
    with pytest.raises(InputError, match=f"capture has {message}"):
        apply_known(TRUE, read_known(KnownGeometry(**known), TRUE, capture=_capture()))


def test_pixels_left_out_have_no_points_and_do_not_move():
    sky = np.zeros(TRUE.depth.shape, bool)
    sky[:, :40] = True
    found = apply_known(TRUE, read_known(KnownGeometry(), TRUE, leave_out=sky))[0]
    assert not found.valid_pixels[sky].any()
    assert not found.dynamic_mask[sky].any()
    np.testing.assert_array_equal(found.depth[~sky], TRUE.depth[~sky])
    assert found.known_facts["left out"] == "71.4% of the pixels"
    inside = np.ones_like(sky)
    inside[:, :, :3] = False  # padding is never left out
    padded = textured_room(4, valid_box=np.tile([3, 0, *TRUE.depth.shape[:0:-1]], (4, 1)))
    for clip, masks in ((TRUE, np.ones_like(sky)), (padded, inside)):
        with pytest.raises(InputError, match="covers every pixel"):
            read_known(KnownGeometry(), clip, leave_out=masks)
