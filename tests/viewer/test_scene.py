"""The data of the page: points where the result has them, colours that it offers, cameras that agree."""

import dataclasses

import numpy as np
import pytest

from tests.room import make_room
from vggtjax.known.apply import scaled
from vggtjax.results.result import missing_fields
from vggtjax.results.shown import middle_and_radius
from vggtjax.viewer.page import viewer_page
from vggtjax.viewer.scene import Budget, Place, home_view, place_beside, scene_of

SAME = Place(1.0, np.eye(3), np.zeros(3))


def positions_of(scene):
    """What client/data.js does."""
    inside = scene["positions"].reshape(-1, 3) / 32767.5 - 1
    return scene["centre"] + scene["scale"] * inside / (1 - np.linalg.norm(inside, axis=-1, keepdims=True))


def names(result):
    return [color["name"] for color in scene_of(result, "room", SAME, budget=Budget())["colors"]]


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


def test_only_colours_that_the_result_has_are_offered():
    result = make_room(3)
    everything = ["picture", "depth", "confidence", "mask", "object", "saliency", "pass", "time"]
    assert names(result) == everything
    fused = dataclasses.replace(result, settings={"fusion": "abc"})
    assert names(fused) == [*everything[:3], "fused precision", *everything[3:]]
    assert "pass" not in names(dataclasses.replace(result, method="vggt"))
    missing = {"missing": ["images", "dynamic_mask", "depth_confidence"]}
    still = np.zeros_like(result.dynamic_mask)
    foreign = dataclasses.replace(result, method="cut3r", saliency=None, dynamic_mask=still, settings=missing)
    assert names(foreign) == ["depth", "time"]
    for missing in (7, {"images": 1}, [["images"], 7, None]):  # nothing
        assert missing_fields(make_room(2, settings={"missing": missing})) == ()


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


@pytest.mark.parametrize("factor", [1e-20, 1e15])
def test_worlds_of_any_size(factor):
    room = make_room(2)
    other = scaled(room, factor)
    for place in (SAME, place_beside(other, room)):
        scene = scene_of(other, "other", place, budget=Budget())
        assert scene["staticCount"] > 100
        assert np.isfinite(positions_of(scene)).all()


def test_depth_at_the_end_of_float32_still_gives_a_page():
    far = make_room(2, depth=np.full((2, 28, 42), 3e38, np.float32))
    for results in ([far], [make_room(2), far], [far, make_room(2)]):
        assert "Infinity" not in viewer_page(results)
    empty = dataclasses.replace(make_room(1), depth=np.zeros((1, 28, 42), np.float32), timestamps=None)
    assert scene_of(empty, "empty", SAME, budget=Budget())["offsets"].tolist() == [0, 0]


def test_the_first_view_stands_behind_and_above_the_middle_camera_and_looks_along_it():
    result = make_room(3)
    home = home_view(result, SAME)
    camera = result.camera_from_world[1]
    eye, target = (camera[:, :3] @ home[name] + camera[:, 3] for name in ("eye", "target"))
    depth = np.median(result.depth[1])
    np.testing.assert_allclose(target, [0, 0, depth], atol=1e-4)
    assert abs(eye[0]) < 1e-4
    assert -0.2 * depth < eye[1] < 0  # y is down
    assert -0.7 * depth < eye[2] < -0.1 * depth
    np.testing.assert_allclose(home["tangents"], [21 / 37.8, 14 / 37.8], rtol=1e-5)
