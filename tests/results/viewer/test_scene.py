"""The data of the page: points where the result has them, colours that it offers, cameras that agree."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.shared.room import make_room
from vggtjax.results.shown import middle_and_radius
from vggtjax.results.viewer.home import Place, home_view
from vggtjax.results.viewer.scene import Budget, place_beside, scene_of

SAME = Place(1.0, np.eye(3), np.zeros(3))


def positions_of(scene):
    """What client/data.js does."""
    inside = scene["positions"].reshape(-1, 3) / 32767.5 - 1
    return scene["centre"] + scene["scale"] * inside / (1 - np.linalg.norm(inside, axis=-1, keepdims=True))


def test_moving_points_lie_on_the_box_of_their_frame():
    result = make_room(4)
    scene = scene_of(result, "room", SAME, budget=Budget())
    positions, points = positions_of(scene), result.world_points()
    _, radius = middle_and_radius(result)
    for frame in range(4):
        chosen = positions[scene["offsets"][frame] : scene["offsets"][frame + 1]]
        mask = result.dynamic_mask[frame]
        distances = np.linalg.norm(chosen[:, None] - points[frame][mask], axis=-1).min(axis=1)
        assert len(chosen) > 0.5 * mask.sum()
        assert distances.max() < 1e-3 * radius
    assert len(positions) == scene["offsets"][-1]
    assert all(len(color["values"]) in (len(positions), 3 * len(positions)) for color in scene["colors"])


def test_points_are_as_wide_as_their_footprint_at_any_distance():
    result = make_room(4)
    scene = scene_of(result, "room", SAME, budget=Budget())
    narrowest, doublings = scene["widths"]
    widths = narrowest * 2 ** (doublings * scene["quality"].reshape(-1, 3)[:, 2] / 255)
    positions, points = positions_of(scene), result.world_points().reshape(-1, 3)
    _, nearest = KDTree(points).query(positions)
    footprints = (result.depth / result.intrinsics[:, 0, 0, None, None]).ravel()[nearest]
    assert footprints.max() > 1.5 * footprints.min()
    assert (widths > 1.3 * footprints).all()
    assert (widths < 3 * footprints).all()


def test_the_first_view_has_the_framing_of_the_middle_picture_and_the_cameras_below_the_subject():
    result = make_room(5)
    view, W = home_view(result, SAME), result.depth.shape[2]
    eye, target = np.array(view["eye"]), np.array(view["target"])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    depth = np.median(result.depth[2])
    wide = view["tangents"][0] * np.linalg.norm(target - eye)
    assert wide == pytest.approx(depth * W / 2 / result.intrinsics[2, 0, 0], rel=1e-5)
    below = (result.camera_centres[2] - eye) @ -np.array(view["up"])
    assert 0.5 < below / ((result.camera_centres[2] - eye) @ ahead) / view["tangents"][1] < 1.5


def turned(result, degrees):
    """The result with another world: in its middle frame all is seen aside."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)
    cameras = result.camera_from_world.copy()
    cameras[len(cameras) // 2] = turn @ cameras[len(cameras) // 2]
    return dataclasses.replace(result, camera_from_world=cameras)


@pytest.mark.parametrize("degrees", [0, 20, -20])
def test_the_first_view_shows_most_of_the_room_and_the_middle_of_what_moves_before_it(degrees):
    result = turned(make_room(9), degrees)  # the middle camera, from which the view starts, looks aside
    view = {name: np.array(value) for name, value in home_view(result, SAME).items()}
    ahead = (view["target"] - view["eye"]) / np.linalg.norm(view["target"] - view["eye"])
    right = np.cross(ahead, view["up"])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    points = (result.world_points() - view["eye"]) @ axes.T
    at = np.abs(points[..., :2] / points[..., 2:] / view["tangents"]).max(axis=-1)
    is_inside = (at < 1) & (points[..., 2] > 0)
    assert is_inside[~result.dynamic_mask].mean() > 0.7
    middle = np.median(points[result.dynamic_mask], axis=0)
    assert np.abs(middle[:2] / middle[2] / view["tangents"]).max() < 1
    static = points[~result.dynamic_mask & is_inside]
    beside = np.abs(static[:, :2] / static[:, 2:] - middle[:2] / middle[2]).max(axis=1) < 0.03
    assert (static[beside, 2] > 0.9 * middle[2]).all()


def test_a_second_result_is_placed_on_the_first_camera_at_its_scale():
    result = make_room(3)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)  # another world, half as large
    moved = result.camera_from_world.copy()
    moved[:, :, :3] = result.camera_from_world[:, :, :3] @ turn.T
    moved[:, :, 3] = 0.5 * result.camera_from_world[:, :, 3] - moved[:, :, :3] @ [1, 2, 3]
    other = dataclasses.replace(result, depth=0.5 * result.depth, camera_from_world=moved)
    place = place_beside(other, result)
    assert place.scale == pytest.approx(2, rel=1e-5)
    np.testing.assert_allclose(place.points(other.world_points()), result.world_points(), atol=1e-4)
    np.testing.assert_allclose(place.points(other.camera_centres), result.camera_centres, atol=1e-5)
