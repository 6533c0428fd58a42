import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vggtjax import cameras as geometry
from vggtjax.errors import ResultError


def test_unproject_at_corners_equals_the_public_code(golden):
    with np.load(golden / "forward_frames4.npz") as arrays:
        depth, intrinsics, camera_from_world, expected = (
            arrays[f"plain/{name}"][0] for name in ("depth", "intrinsic", "extrinsic", "world_points_from_depth")
        )
    points = geometry.unproject(depth[..., 0], intrinsics, camera_from_world, pixel_offset=0.0)
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, expected, rtol=1e-5, atol=1e-5 * expected.std())


@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    centre=st.tuples(*[st.floats(-5, 5)] * 3),
    focal=st.tuples(*[st.floats(5, 100)] * 2),
    seed=st.integers(0, 100),
)
def test_unprojected_points_project_to_pixel_centres(turn, centre, focal, seed):
    rotation = Rotation.from_rotvec(turn).as_matrix()
    camera_from_world = np.concatenate([rotation, -rotation @ np.array(centre)[:, None]], axis=1)[None]
    intrinsics = np.array([[[focal[0], 0, 4], [0, focal[1], 3], [0, 0, 1]]])
    depth = np.random.default_rng(seed).uniform(0.5, 20, (1, 6, 8))
    points = geometry.unproject(
        *(array.astype(np.float32) for array in (depth, intrinsics, camera_from_world)), pixel_offset=0.5
    )
    seen = points[0] @ rotation.T + camera_from_world[0, :, 3]
    seen = seen @ intrinsics[0].T
    np.testing.assert_allclose(seen[..., 2], depth[0], rtol=1e-4, atol=1e-5)
    y, x = np.mgrid[0:6, 0:8] + 0.5
    np.testing.assert_allclose(seen[..., :2] / seen[..., 2:], np.stack([x, y], axis=-1), atol=2e-2)


def test_inverse_and_centres_by_hand():
    camera_from_world = np.array([[[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]], np.float32)
    np.testing.assert_array_equal(geometry.camera_centres(camera_from_world), [[-2, 1, -3]])
    expected = [[[0, 1, 0, -2], [-1, 0, 0, 1], [0, 0, 1, -3], [0, 0, 0, 1]]]
    np.testing.assert_array_equal(geometry.world_from_camera(camera_from_world), expected)


def test_fields_of_view_are_clamped_where_they_must():
    fov = np.array([[1.0, 0.5], [0.0, 1.0], [1.0, 4.0], [np.inf, -1.0], [0.01, 3.1]])
    clamped, frames = geometry.clamp_field_of_view(fov)
    np.testing.assert_array_equal(clamped, [[1.0, 0.5], [0.01, 1.0], [1.0, 3.1], [3.1, 0.01], [0.01, 3.1]])
    assert frames == (1, 2, 3)
    with pytest.raises(ResultError, match="frame 1 is not a number"):
        geometry.clamp_field_of_view(np.array([[1.0, 1.0], [1.0, np.nan]]))


def test_frustum_corners_by_hand():
    intrinsics = np.array([[[3, 0, 3], [0, 2, 2], [0, 0, 1]]], np.float32)  # 90 degrees both ways
    camera_from_world = np.concatenate([np.eye(3), [[0], [0], [-1]]], axis=1, dtype=np.float32)[None]
    corners = geometry.frustum_corners(intrinsics, camera_from_world, height=4, width=6, size=3**0.5)
    expected = [[0, 0, 1], [-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]]
    np.testing.assert_allclose(corners[0], expected, atol=1e-6)
