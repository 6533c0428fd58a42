"""Several known things together, what a capture tells, pixels that are left out, and all through a reconstruction."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.shared.moving_ball import moving_ball
from tests.shared.room import textured_room
from vggtjax import Reconstruction, reconstruct, reconstruct_many
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


@pytest.mark.filterwarnings("ignore:the field of view")
def test_masks_intrinsics_and_scale_reach_the_result(model, clip, tmp_path):
    height, width = clip.source_size[0]
    sky = np.zeros((height, width), np.uint8)
    sky[: height // 2] = 255
    for name in clip.frame_names:
        Image.fromarray(sky).save(tmp_path / f"{name}.png")
    (tmp_path / "depths.csv").write_text(f"frame,x,y,depth\n1,{width / 2},{height - 1},3\n")
    K, depths = f"{1.2 * width},{1.2 * width},{width / 2},{height / 2}", str(tmp_path / "depths.csv")
    known = KnownGeometry(intrinsics=K, known_depths=depths, leave_out=tmp_path)
    plain = reconstruct(model, clip, method="vggt")
    made = reconstruct(model, clip, method="vggt", known=known)
    kept = made.depth[:, 28:]
    assert not made.depth[:, :28].any()
    np.testing.assert_allclose(kept / plain.depth[:, 28:], made.depth[1, 55, 28] / plain.depth[1, 55, 28], rtol=1e-5)
    assert made.depth[1, 55, 28] == pytest.approx(3)
    np.testing.assert_allclose(made.intrinsics[:, [0, 1], [0, 1]], 1.2 * 56, rtol=1e-6)
    assert made.settings["known"]["known_depths"] == depths
    assert set(made.known_facts) == {"left out", "intrinsics", "scale"}


@pytest.mark.filterwarnings("ignore:the field of view")
def test_a_batch_takes_what_its_clips_share(model, tmp_path):
    frames = (255 * np.asarray(moving_ball(3))).astype(np.uint8)
    (done,) = reconstruct_many(model, {"ball": frames}, tmp_path, method="vggt", known=KnownGeometry(shared_focal=True))
    assert done.status == "done"
    intrinsics = Reconstruction.load(tmp_path / "ball").intrinsics
    np.testing.assert_allclose(intrinsics, intrinsics[:1].repeat(3, axis=0))
    with pytest.raises(InputError, match="--baseline is of one clip"):
        next(reconstruct_many(model, {}, tmp_path, known=KnownGeometry(baseline="0,1,2")))
