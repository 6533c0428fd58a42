import io

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.shared.glb_files import split_glb
from tests.shared.room import WALL, make_room
from vggtjax.results import glb, point_cloud
from vggtjax.results.colors import LINEAR
from vggtjax.results.exports.write import export_result
from vggtjax.results.glb import build_scene, glb_bytes, result_scene


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
    assert (np.diff(LINEAR) > 0).all()
    np.testing.assert_allclose(LINEAR[[0, 10, 255]], [0, 10 / 255 / 12.92, 1], rtol=1e-6)
    greys = np.repeat(np.arange(256), 3).reshape(-1, 3).astype("u1")
    cloud = point_cloud.PointCloud(np.zeros((256, 3), np.float32), greys)
    data = glb_bytes(build_scene(make_room(1), cloud, []))
    tree, read = split_glb(data)
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    (material,) = tree["materials"]
    assert "KHR_materials_unlit" in material["extensions"]
    parts = {mesh["name"]: mesh["primitives"][0] for mesh in tree["meshes"]}
    assert {part["material"] for part in parts.values()} == {0}
    accessor = tree["accessors"][parts["static"]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["count"]) == (5126, "VEC3", 256)
    np.testing.assert_array_equal(read(parts["static"]["attributes"]["COLOR_0"])[:, 0], LINEAR)


def test_points_are_limited_and_reproducible(monkeypatch):
    monkeypatch.setattr(glb, "POINT_LIMIT", 1000)
    room = make_room()
    scene, again = load_scene(room), load_scene(room)
    moving = [f"dynamic_{frame:06d}" for frame in range(3)]
    assert 600 < len(scene.geometry["static"].vertices) <= 800
    assert [len(scene.geometry[name].vertices) for name in moving] == [66] * 3
    for name in ("static", *moving):
        np.testing.assert_array_equal(scene.geometry[name].vertices, again.geometry[name].vertices)


@pytest.mark.parametrize("form", ["scene.glb", "glb-animated"])
def test_the_camera_moves_as_the_clip_s_did(tmp_path, form):
    random = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.linspace(0, 11, 6)[:, None] * [0.6, 0, 0.8])  # quaternions change their sign
    poses = np.concatenate([turns.as_matrix(), random.normal(size=(6, 3, 1))], axis=-1).astype(np.float32)
    times = np.array([0, 0.1, 0.4, 0.5, 0.9, 1])
    intrinsics = np.zeros((6, 3, 3), np.float32)
    intrinsics[:] = [[30, 0, 21], [0, 0, 14], [0, 0, 1]]
    intrinsics[:, 1, 1] = np.linspace(20, 45, 6)
    room = make_room(6, camera_from_world=poses, timestamps=times, intrinsics=intrinsics)
    if form == "scene.glb":
        room.save(tmp_path, only=("scene",))
    else:
        export_result(room, tmp_path / "scene.glb", "glb-animated")
    tree, values = split_glb((tmp_path / "scene.glb").read_bytes())
    number, node = next((number, node) for number, node in enumerate(tree["nodes"]) if node.get("camera") == 0)
    assert number in tree["scenes"][tree["scene"]]["nodes"]
    lens = tree["cameras"][0]["perspective"]
    assert lens["yfov"] == pytest.approx(2 * np.arctan(14 / 32.5), abs=0.01)  # the middle of 30 and 35
    assert lens["aspectRatio"] == pytest.approx(42 / 28 * 32.5 / 30)
    assert 0 < lens["znear"] < 0.1
    curves = {}
    (animation,) = tree["animations"]
    for channel in animation["channels"]:
        target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
        if target.get("node") in (number, None):
            np.testing.assert_allclose(values(sampler["input"])[:, 0], times, atol=1e-6)
            curves[target["path"]] = values(sampler["output"])
    y_up = np.diag([1, -1, -1])
    matrices = Rotation.from_quat(curves["rotation"]).as_matrix()
    wanted = y_up @ room.world_from_camera[:, :3, :3] @ y_up
    np.testing.assert_allclose(matrices, wanted, atol=1e-5)
    np.testing.assert_allclose(curves["translation"], room.world_from_camera[:, :3, 3] @ y_up, atol=1e-5)
    assert ((curves["rotation"][1:] * curves["rotation"][:-1]).sum(axis=1) > 0).all()  # the shorter way round
    np.testing.assert_allclose(curves["pointer"][:, 0], 2 * np.arctan(14 / intrinsics[:, 1, 1]), rtol=1e-6)
    np.testing.assert_allclose(node["translation"], curves["translation"][0], atol=1e-6)
    np.testing.assert_allclose(node["rotation"], curves["rotation"][0], atol=1e-6)
