from typing import Any

import numpy as np
import pytest
import trimesh

from tests.room import make_room
from vggtjax.results import point_cloud
from vggtjax.results.frame import LeastConfidence, frame_of


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


@pytest.mark.parametrize("resolution", ["model", "original"])
def test_what_moves_stays_in_the_same_share(resolution):
    room = make_room(frames=4)
    room = make_room(frames=4, depth_confidence=room.depth_confidence + ~room.dynamic_mask)  # C1 + C2, but C1
    least = point_cloud.least_confidence(room, 20)
    frames = [frame_of(room, number, resolution) for number in range(4)]
    for region in (False, True):
        chosen = np.concatenate([f.confident(least)[f.valid & (f.dynamic_mask == region)] for f in frames])
        assert chosen.mean() == pytest.approx(0.8, abs=2e-3)


def load_cloud(path) -> Any:
    return trimesh.load(path)


def test_files_keep_what_moves_in_the_same_share(tmp_path):
    room = make_room(frames=4)
    confidence = (room.depth_confidence + ~room.dynamic_mask).astype(np.float32)
    make_room(frames=4, depth_confidence=confidence).save(tmp_path)
    count = {path: len(load_cloud(path).vertices) for path in tmp_path.rglob("*.ply")}
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


def test_clouds_are_the_chosen_points():
    room = make_room()
    points = room.world_points()
    for number, pixels in enumerate(confident(room, 30)):
        cloud = point_cloud.frame_cloud(frame_of(room, number), pixels)
        np.testing.assert_allclose(cloud.points, points[number][pixels], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(cloud.colors, room.images[number][pixels])


def test_clouds_one_after_the_other():
    clouds = [point_cloud.PointCloud(np.full((n, 3), n, np.float32), np.full((n, 3), n, np.uint8)) for n in (2, 0, 1)]
    together = point_cloud.joined(clouds)
    assert together.points[:, 0].tolist() == together.colors[:, 2].tolist() == [2, 2, 1]


def test_points_too_far_for_float32_are_left_out():
    room = make_room(1)
    depth = room.depth.copy()
    depth[0, 0, 0] = 3e38
    intrinsics = room.intrinsics.copy()
    intrinsics[0, 0, 0] = 0.5
    frame = frame_of(make_room(1, depth=depth, intrinsics=intrinsics), 0)
    assert frame.valid.all()
    assert len(point_cloud.frame_cloud(frame, frame.valid)) == frame.valid.sum() - 1


def test_nothing_to_show():
    room = make_room(2, depth=np.zeros((2, 28, 42), np.float32))
    assert point_cloud.least_confidence(room, 20) == LeastConfidence(0, 0)
    cloud = point_cloud.frame_cloud(frame_of(room, 0), frame_of(room, 0).valid)
    assert cloud.points.shape == (0, 3)
    assert cloud.colors.dtype == np.uint8
