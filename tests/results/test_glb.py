import io
import json

import numpy as np
import trimesh

from tests.room import WALL, make_room
from vggtjax.results import glb, point_cloud
from vggtjax.results.glb import _LINEAR, build_scene, glb_bytes, result_scene


def load_scene(room):
    """Return the scene of a result, through a GLB file."""
    return trimesh.load_scene(io.BytesIO(glb_bytes(result_scene(room, 0.0))), file_type="glb")


def test_nodes_and_points():
    room = make_room()
    scene = load_scene(room)
    names = {"static", "cameras", "dynamic_000000", "dynamic_000001", "dynamic_000002"}
    assert set(scene.graph.nodes_geometry) == set(scene.geometry) == names
    static = scene.geometry["static"].vertices
    assert len(static) == (~room.dynamic_mask).sum()
    np.testing.assert_allclose(static[:, 2], -WALL, rtol=1e-5)  # glTF looks along -z
    highest = room.world_points()[~room.dynamic_mask][:, 1].min()  # y is down in the result, up in the file
    np.testing.assert_allclose(static[:, 1].max(), -highest, rtol=1e-5)
    # linear: ((220 / 255 + 0.055) / 1.055) ** 2.4 = 0.7157; 40 -> 0.0212; 30 -> 0.0130
    assert (scene.geometry["dynamic_000001"].colors == (183, 5, 3, 255)).all()


def test_dark_tones_stay_apart_and_nothing_is_lit():
    assert (np.diff(_LINEAR) > 0).all()
    np.testing.assert_allclose(_LINEAR[[0, 10, 255]], [0, 10 / 255 / 12.92, 1], rtol=1e-6)
    greys = np.repeat(np.arange(256), 3).reshape(-1, 3).astype("u1")
    cloud = point_cloud.PointCloud(np.zeros((256, 3), np.float32), greys)
    data = glb_bytes(build_scene(make_room(1), cloud, []))
    size = int.from_bytes(data[12:16], "little")
    tree, buffer = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    (material,) = tree["materials"]
    assert "KHR_materials_unlit" in material["extensions"]
    parts = {mesh["name"]: mesh["primitives"][0] for mesh in tree["meshes"]}
    assert {part["material"] for part in parts.values()} == {0}
    accessor = tree["accessors"][parts["static"]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["count"]) == (5126, "VEC3", 256)
    view = tree["bufferViews"][accessor["bufferView"]]
    values = np.frombuffer(buffer, np.float32, 3 * 256, view["byteOffset"]).reshape(-1, 3)
    np.testing.assert_array_equal(values[:, 0], _LINEAR)


def test_points_are_limited_and_reproducible(monkeypatch):
    monkeypatch.setattr(glb, "POINT_LIMIT", 1000)
    room = make_room()
    scene, again = load_scene(room), load_scene(room)
    moving = [f"dynamic_{frame:06d}" for frame in range(3)]
    assert 600 < len(scene.geometry["static"].vertices) <= 800
    assert [len(scene.geometry[name].vertices) for name in moving] == [66] * 3
    for name in ("static", *moving):
        np.testing.assert_array_equal(scene.geometry[name].vertices, again.geometry[name].vertices)
