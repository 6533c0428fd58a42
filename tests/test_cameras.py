"""Cameras, and similarities of worlds: composed, inverted, and fitted with weights."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vggtjax import cameras as geometry
from vggtjax.cameras import Similarity, umeyama_sim3
from vggtjax.errors import InputError, ResultError


def test_unproject_at_corners_equals_the_public_code(golden):
    with np.load(golden / "forward_frames4.npz") as arrays:
        names = ("depth", "intrinsic", "extrinsic", "world_points_from_depth")
        depth, intrinsics, camera_from_world, expected = (arrays[f"plain/{name}"][0] for name in names)
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
    single = (array.astype(np.float32) for array in (depth, intrinsics, camera_from_world))
    points = geometry.unproject(*single, pixel_offset=0.5)
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


seeds = st.integers(0, 2**32 - 1)


def random_similarity(generator) -> Similarity:
    rotation = Rotation.random(rng=generator).as_matrix()
    return Similarity(float(np.exp(generator.normal())), rotation, 5 * generator.normal(size=3))


def test_after_by_hand():
    turned = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 0, 0]))
    moved = Similarity(1.0, np.eye(3), np.array([0.0, 3, 0]))
    point = np.array([[1.0, 0, 0]])
    assert np.allclose(moved.after(turned).apply(point), [[1, 5, 0]])  # (1, 0, 0) -> (1, 2, 0) -> (1, 5, 0)
    assert np.allclose(turned.after(moved).apply(point), [[-5, 2, 0]])  # -> (1, 3, 0) -> (-6 + 1, 2, 0)


@settings(max_examples=30)
@given(seed=seeds)
def test_a_whole_weight_is_as_many_points(seed):
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(6, 3))
    target = random_similarity(generator).apply(source) + 0.2 * generator.normal(size=(6, 3))
    times = np.array([1, 2, 3, 1, 1, 4])
    one = umeyama_sim3(source, target, weights=times.astype(float))
    other = umeyama_sim3(np.repeat(source, times, axis=0), np.repeat(target, times, axis=0))
    assert one.scale == pytest.approx(other.scale)
    assert np.allclose(one.rotation, other.rotation)
    assert np.allclose(one.translation, other.translation)
    with pytest.raises(InputError, match="6 weights for 7 points"):
        umeyama_sim3(np.eye(7, 3), np.eye(7, 3), weights=np.ones(6))
