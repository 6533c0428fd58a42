import numpy as np
import pytest

from tests.room import make_room
from vggtjax.errors import InputError
from vggtjax.results import point_cloud


def test_percentile_is_taken_over_the_clip_and_ties_stay():
    confidence = np.ones((2, 14, 14), np.float32)
    confidence[0, 0, :4] = (0.1, 0.2, 0.3, 0.4)
    room = make_room(2, 14, 14, depth_confidence=confidence)
    kept = point_cloud.confident_pixels(room, 100 * 2 / 391)  # the third lowest of 392
    assert (~kept).sum() == 2
    assert not kept[0, 0, :2].any()
    assert point_cloud.confident_pixels(room, 0).all()
    assert point_cloud.confident_pixels(room, 50).sum() == 388  # all the ones tie with the median


def test_share_that_stays():
    room = make_room(frames=4)
    assert point_cloud.confident_pixels(room, 20).mean() == pytest.approx(0.8, abs=1e-3)


def test_pixels_without_a_point():
    room = make_room()
    depth, confidence = room.depth.copy(), room.depth_confidence.copy()
    depth[0, 0, :4] = (np.inf, np.nan, 0, -1)
    confidence[1, 0, :2] = (np.inf, np.nan)
    box = room.valid_box.copy()
    box[2] = (3, 5, 40, 27)
    valid = point_cloud.valid_pixels(make_room(depth=depth, depth_confidence=confidence, valid_box=box))
    expected = np.ones_like(valid)
    expected[0, 0, :4] = expected[1, 0, :2] = False
    expected[2] = False
    expected[2, 5:27, 3:40] = True
    np.testing.assert_array_equal(valid, expected)


@pytest.mark.parametrize("percentile", [-1, 100, float("nan")])
def test_percentile_out_of_range(percentile):
    with pytest.raises(InputError, match=r"expected at least 0 and below 100"):
        point_cloud.confident_pixels(make_room(1), percentile)


def test_clouds_share_the_pixels_between_them():
    room = make_room()
    pixels = point_cloud.confident_pixels(room, 30)
    static, dynamic = point_cloud.static_cloud(room, pixels), point_cloud.dynamic_clouds(room, pixels)
    whole = [point_cloud.frame_cloud(room, frame, chosen) for frame, chosen in enumerate(pixels)]
    assert len(static) + sum(map(len, dynamic)) == sum(map(len, whole)) == pixels.sum()
    points = room.world_points()
    np.testing.assert_allclose(static.points, points[pixels & ~room.dynamic_mask], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(static.colors, room.images[pixels & ~room.dynamic_mask])
    np.testing.assert_allclose(dynamic[1].points, points[1][(pixels & room.dynamic_mask)[1]], rtol=1e-5, atol=1e-6)
    assert (dynamic[1].colors == (220, 40, 30)).all()


def test_points_too_far_for_float32_are_left_out():
    room = make_room(1)
    depth = room.depth.copy()
    depth[0, 0, 0] = 3e38
    intrinsics = room.intrinsics.copy()
    intrinsics[0, 0, 0] = 0.5
    room = make_room(1, depth=depth, intrinsics=intrinsics)
    pixels = point_cloud.confident_pixels(room, 0)
    assert pixels.all()
    assert len(point_cloud.static_cloud(room, pixels)) == pixels.sum() - room.dynamic_mask.sum() - 1


def test_nothing_to_show():
    room = make_room(2, depth=np.full((2, 28, 42), np.inf, np.float32))
    pixels = point_cloud.confident_pixels(room, 20)
    assert not pixels.any()
    assert point_cloud.static_cloud(room, pixels).points.shape == (0, 3)
    assert point_cloud.static_cloud(room, pixels).colors.dtype == np.uint8
