import numpy as np
import pytest
import trimesh

from tests.results.test_export import read_ply
from tests.room import make_room
from vggtjax.results import point_cloud
from vggtjax.results.frame import frame_of


def confident(room, percentile):
    least = point_cloud.least_confidence(room, percentile)
    return np.stack([frame_of(room, number).confident(least) for number in range(len(room.depth))])


def test_percentile_is_taken_over_the_clip_and_ties_stay():
    confidence = np.ones((2, 14, 14), np.float32)
    confidence[0, 0, :4] = (0.1, 0.2, 0.3, 0.4)
    room = make_room(2, 14, 14, depth_confidence=confidence, dynamic_mask=np.zeros((2, 14, 14), bool))
    kept = confident(room, 100 * 2 / 391)  # the third lowest of 392
    assert (~kept).sum() == 2
    assert not kept[0, 0, :2].any()
    assert confident(room, 0).all()
    assert confident(room, 50).sum() == 388  # all the ones tie with the median


def test_files_keep_what_moves_in_the_same_share(tmp_path):
    room = make_room(frames=4)
    confidence = (room.depth_confidence + ~room.dynamic_mask).astype(np.float32)
    make_room(frames=4, depth_confidence=confidence).save(tmp_path)
    count = {path: len(read_ply(path).vertices) for path in tmp_path.rglob("*.ply")}
    static = count.pop(tmp_path / "static.ply")
    scene = trimesh.load_scene(tmp_path / "scene.glb").geometry
    moving = sum(len(part.vertices) for name, part in scene.items() if name.startswith("dynamic"))
    shares = {
        "static.ply": static / (~room.dynamic_mask).sum(),
        "frames/": (sum(count.values()) - static) / room.dynamic_mask.sum(),
        "static in scene.glb": len(scene["static"].vertices) / (~room.dynamic_mask).sum(),
        "dynamic in scene.glb": moving / room.dynamic_mask.sum(),
    }
    assert shares == pytest.approx(dict.fromkeys(shares, 0.8), abs=2e-3)


def test_points_too_far_for_float32_are_left_out():
    room = make_room(1)
    depth = room.depth.copy()
    depth[0, 0, 0] = 3e38
    intrinsics = room.intrinsics.copy()
    intrinsics[0, 0, 0] = 0.5
    frame = frame_of(make_room(1, depth=depth, intrinsics=intrinsics), 0)
    assert frame.valid.all()
    assert len(point_cloud.frame_cloud(frame, frame.valid)) == frame.valid.sum() - 1
