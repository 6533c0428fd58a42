import re
from typing import Any

import numpy as np
import pytest
import trimesh

from tests.shared.room import WALL, make_room
from vggtjax.errors import InputError
from vggtjax.results.exports.mesh import static_mesh
from vggtjax.results.exports.table import Exporting
from vggtjax.results.exports.volume import MOST_VOXELS, StaticSurfaces
from vggtjax.results.exports.write import export_result

ALL = Exporting(confidence_percentile=0)
STILL = np.tile(np.eye(4, dtype=np.float32)[:3], (2, 1, 1))


def walls(*depths, weights=(1, 1)):
    """Return a result of two frames of one camera before a wall, at a depth and of a confidence of each frame."""
    ones = np.ones((2, 28, 42), np.float32)
    return make_room(
        2,
        depth=ones * np.reshape(depths, (2, 1, 1)),
        depth_confidence=ones * np.reshape(weights, (2, 1, 1)),
        dynamic_mask=ones < 0,
        camera_from_world=STILL,
    )


def colors_of(mesh: Any) -> np.ndarray:
    return mesh.visual.vertex_colors[:, :3]


def test_frames_count_by_their_precision():
    mesh = static_mesh(walls(5.0, 5.1, weights=(3, 1)), Exporting(confidence_percentile=0, voxel_size=0.05))
    np.testing.assert_allclose(mesh.vertices[:, 2], (3 * 5 + 5.1) / 4, atol=1e-5)
    # between the centres of the outer pixels, seen 5.025 away
    np.testing.assert_allclose(mesh.bounds[1, :2], 5.025 * np.array([20.5, 13.5]) / 37.8, atol=0.05)


def test_what_lies_behind_the_reach_is_not_mixed_in():
    mesh = static_mesh(walls(5.0, 8.0), Exporting(confidence_percentile=0, voxel_size=0.1))
    np.testing.assert_allclose(mesh.vertices[:, 2], 8, atol=1e-4)  # the second camera looks through the first wall


def test_static_surfaces_alone_in_colour_and_facing_the_cameras():
    room = make_room(4, 56, 84)
    mesh = static_mesh(room, ALL)
    np.testing.assert_allclose(mesh.vertices[:, 2], WALL, atol=2e-3)
    assert (mesh.face_normals[:, 2] < -0.9).all()
    colors = colors_of(mesh)
    assert 60 <= colors.min() <= colors.max() <= 100
    assert np.ptp(colors, axis=0).min() > 30


@pytest.mark.parametrize("confidence", [0.0, 3.4e38])
def test_confidence_of_any_size_gives_finite_vertices_with_colours(confidence):
    mesh = static_mesh(make_room(depth_confidence=np.full((3, 28, 42), confidence, np.float32)), ALL)
    assert len(mesh.vertices) > 100
    assert np.isfinite(mesh.vertices).all()
    assert colors_of(mesh).max(axis=1).min() >= 50  # the darkest square of the wall has 60


def test_files(tmp_path):
    room, steps = make_room(), []
    export_result(room, tmp_path / "mesh.ply", "mesh", progress=lambda done, total: steps.append((done, total)))
    assert steps == [(done, 12) for done in range(1, 13)]
    export_result(room, tmp_path / "mesh.glb", "mesh")
    plain = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    scene = trimesh.load_scene(tmp_path / "mesh.glb", process=False)
    turned = scene.geometry["static"]
    np.testing.assert_allclose(turned.vertices, plain.vertices * [1, -1, -1], atol=1e-6)
    np.testing.assert_array_equal(turned.faces, plain.faces)
    assert colors_of(plain).min() >= 60
    assert scene.has_camera


def test_what_cannot_be_a_mesh_is_one_sentence(tmp_path):
    room = make_room()
    with pytest.raises(InputError, match=r"voxels of 0.001 need \d+ x \d+ x \d+ of them, more than 67108864") as found:
        export_result(room, tmp_path / "out.glb", "mesh", exporting=Exporting(voxel_size=0.001))
    (smallest,) = re.findall(r"the smallest that fit are ([\d.]+)", str(found.value))
    surfaces = StaticSurfaces(room, 20.0)
    assert 0.9 * MOST_VOXELS < np.prod(surfaces.grid(float(smallest)).shape) <= MOST_VOXELS
    with pytest.raises(InputError, match="voxels of 1e-200 need"):
        surfaces.grid(1e-200)
    moving = make_room(dynamic_mask=np.ones((3, 28, 42), bool))
    with pytest.raises(InputError, match="no pixel is static"):
        export_result(moving, tmp_path / "out.glb", "mesh")
    with pytest.raises(InputError, match=r"voxels of 99 find no surface: they are too large"):
        export_result(room, tmp_path / "out.glb", "mesh", exporting=Exporting(voxel_size=99))
    with pytest.raises(InputError, match=r"ends with \.glb or \.ply"):
        export_result(room, tmp_path / "out.obj", "mesh")
    assert not list(tmp_path.iterdir())
