"""The scene for Blender: the files that its script reads, and the camera that Blender makes of them."""

import json
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.shared.room import make_room
from vggtjax.clips.sources import open_source
from vggtjax.errors import InputError
from vggtjax.results.exports.table import Exporting
from vggtjax.results.exports.write import export_result

FRAMES, H, W = 3, 28, 42
_READ = """
import json, runpy, sys, bpy
runpy.run_path(sys.argv[1], run_name="__main__")
scene = bpy.data.scenes["vggtjax"]
found = []
for frame in range(1, scene.frame_end + 1):
    scene.frame_set(frame)
    camera, background = scene.camera, scene.camera.data.background_images[0]
    found.append({
        "matrix": [list(row) for row in camera.matrix_world],
        "corners": [list(corner) for corner in camera.data.view_frame(scene=scene)],
        "picture": background.image.filepath_from_user(image_user=background.image_user),
        "moving": [o.name for o in scene.objects if o.name.startswith("moving") and not o.hide_render],
        "points": len(scene.objects["static"].data.vertices),
        "rate": scene.render.fps / scene.render.fps_base,
    })
print("FOUND" + json.dumps(found))
"""


def exported(tmp_path, **changes):
    intrinsics = np.tile(np.array([[37, 0, 24], [0, 31, 12], [0, 0, 1]], np.float32), (FRAMES, 1, 1))
    room = make_room(FRAMES, H, W, **{"intrinsics": intrinsics, "timestamps": np.arange(3) / 2.5} | changes)
    export_result(room, tmp_path / "out", "blender", exporting=Exporting(200))
    return room


def test_files_of_the_scene(tmp_path):
    room = exported(tmp_path)
    facts = json.loads((tmp_path / "out/scene.json").read_text())
    assert (facts["width"], facts["height"], facts["frames_a_second"]) == (W, H, pytest.approx(2.5))
    for number, frame in enumerate(facts["frames"]):
        np.testing.assert_allclose(frame["world_from_camera"], room.world_from_camera[number], atol=1e-6)
        assert [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")] == [37, 31, 24, 12]
        assert frame["picture"] == f"pictures/{number + 1:06d}.png"
        with Image.open(tmp_path / "out" / frame["picture"]) as picture:
            np.testing.assert_array_equal(np.asarray(picture), room.images[number])
        moving = trimesh.load(tmp_path / f"out/moving/{number + 1:06d}.ply")
        assert isinstance(moving, trimesh.PointCloud)
        assert (moving.colors[:, 0] == 220).all()
    static = trimesh.load(tmp_path / "out/static.ply")
    assert isinstance(static, trimesh.PointCloud)
    apart = np.linalg.norm(static.vertices[:, None] - static.vertices, axis=-1) + 99 * np.eye(len(static.vertices))
    assert facts["point_radius"] == pytest.approx(np.median(apart.min(axis=0)) / 2, rel=1e-4)
    compile((tmp_path / "out/scene.py").read_text(), "scene.py", "exec")


def test_pictures_of_several_sizes_are_refused(tmp_path):
    sizes = np.array([[56, 84], [56, 84], [84, 56]])
    room = make_room(FRAMES, H, W, source_size=sizes, frame_names=["a", "b", "c"])
    (tmp_path / "pictures").mkdir()
    for name, (height, width) in zip("abc", sizes.tolist(), strict=True):
        Image.new("RGB", (width, height)).save(tmp_path / f"pictures/{name}.png")
    source = open_source(str(tmp_path / "pictures"))
    with pytest.raises(InputError, match=r"frame 3 has 56 x 84 pixels and the first 84 x 56; .* leave out"):
        export_result(room, tmp_path / "out", "blender", source=source)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(find_spec("bpy") is None, reason="bpy, which is Blender as a module, is not installed")
def test_blender_makes_the_camera(tmp_path):
    room = exported(tmp_path)
    command = [sys.executable, "-c", _READ, str(tmp_path / "out/scene.py")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    frames = json.loads(printed.split("FOUND")[1].splitlines()[0])
    z_up, opengl = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), np.diag([1, -1, -1])
    for number, frame in enumerate(frames):
        matrix, pose = np.array(frame["matrix"]), room.world_from_camera[number]
        np.testing.assert_allclose(matrix[:3, 3], z_up @ pose[:3, 3], atol=1e-5)
        np.testing.assert_allclose(matrix[:3, :3], z_up @ pose[:3, :3] @ opengl, atol=1e-5)
        corners = np.array(frame["corners"])
        corners = corners[:, :2] / -corners[:, 2:]  # right top, right bottom, left bottom, left top of the picture
        wanted = [[W - 24, 12], [W - 24, 12 - H], [-24, 12 - H], [-24, 12]] / np.array([37, 31])
        np.testing.assert_allclose(corners, wanted, atol=1e-5)
        assert frame["picture"].endswith(f"pictures/{number + 1:06d}.png")
        assert frame["moving"] == [f"moving_{number + 1:06d}"]
        assert frame["points"] > 100
        assert frame["rate"] == pytest.approx(2.5)
