import numpy as np
import pytest

from tests.room import make_room
from vggtjax.errors import InputError
from vggtjax.results import point_cloud
from vggtjax.results.frame import frame_of, valid_pixels


def confident(room, percentile):
    return valid_pixels(room) & (room.depth_confidence >= point_cloud.least_confidence(room, percentile))


def test_percentile_is_taken_over_the_clip_and_ties_stay():
    confidence = np.ones((2, 14, 14), np.float32)
    confidence[0, 0, :4] = (0.1, 0.2, 0.3, 0.4)
    room = make_room(2, 14, 14, depth_confidence=confidence)
    kept = confident(room, 100 * 2 / 391)  # the third lowest of 392
    assert (~kept).sum() == 2
    assert not kept[0, 0, :2].any()
    assert confident(room, 0).all()
    assert confident(room, 50).sum() == 388  # all the ones tie with the median


def test_share_that_stays():
    assert confident(make_room(frames=4), 20).mean() == pytest.approx(0.8, abs=1e-3)


@pytest.mark.parametrize("percentile", [-1, 100, float("nan")])
def test_percentile_out_of_range(percentile):
    with pytest.raises(InputError, match=r"expected at least 0 and below 100"):
        point_cloud.least_confidence(make_room(1), percentile)


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
    room = make_room(2, depth=np.full((2, 28, 42), np.inf, np.float32))
    assert point_cloud.least_confidence(room, 20) == 0
    cloud = point_cloud.frame_cloud(frame_of(room, 0), frame_of(room, 0).valid)
    assert cloud.points.shape == (0, 3)
    assert cloud.colors.dtype == np.uint8
