"""The pose encoding: round trips, against scipy, and fields of view that no pinhole has."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vggtjax import decode_pose
from vggtjax.network.heads.pose import encode_pose, matrix_to_quaternion, quaternion_to_matrix

_unit = st.floats(-1, 1, width=32)
_decode = jax.jit(lambda pose: decode_pose(pose, (140, 168)))
_encode = jax.jit(lambda extrinsics, intrinsics: encode_pose(extrinsics, intrinsics, (140, 168)))


@settings(max_examples=80)
@given(st.tuples(_unit, _unit, _unit, _unit).filter(lambda q: np.linalg.norm(q) > 0.1), st.floats(0.1, 3.0))
def test_encode_inverts_decode(quaternion, fov):
    pose = np.array([1.0, -2.0, 3.0, *quaternion, fov, 0.9 * fov], np.float32)
    made = np.asarray(_encode(*_decode(pose)))
    unit = np.asarray(quaternion) / np.linalg.norm(quaternion)
    assert min(np.abs(made[3:7] - unit).max(), np.abs(made[3:7] + unit).max()) < 1e-5
    assert made[6] >= 0
    assert np.allclose(made[[0, 1, 2, 7, 8]], pose[[0, 1, 2, 7, 8]], atol=2e-5)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_rotations_agree_with_scipy(seed):
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    assert np.allclose(quaternion_to_matrix(jnp.asarray(3 * rotation.as_quat())), rotation.as_matrix(), atol=1e-6)
    assert np.allclose(matrix_to_quaternion(jnp.asarray(rotation.as_matrix())), rotation.as_quat(True), atol=1e-6)


def test_half_turns():
    for axis in np.eye(3):
        matrix = Rotation.from_rotvec(np.pi * axis).as_matrix()
        assert np.allclose(np.abs(matrix_to_quaternion(jnp.asarray(matrix))), [*axis, 0], atol=1e-6)


def test_intrinsics_by_hand():
    pose = jnp.asarray([0, 0, 0, 0, 0, 0, 1, np.pi / 2, np.pi / 2], jnp.float32)
    extrinsics, intrinsics = decode_pose(pose, (100, 200))
    assert np.allclose(extrinsics, np.eye(3, 4))
    assert np.allclose(intrinsics, [[100, 0, 100], [0, 50, 50], [0, 0, 1]], atol=1e-4)


def test_every_camera_of_a_batch_is_that_alone():
    poses = jnp.asarray(np.random.default_rng(0).uniform(0.2, 1, (2, 9)), jnp.float32)
    many = _decode(poses)
    for i, pose in enumerate(poses):
        for array, one in zip((*many, _encode(*many)), (*_decode(pose), _encode(*_decode(pose))), strict=True):
            assert np.allclose(array[i], one, atol=1e-5)


def test_odd_fields_of_view_are_not_clamped():
    pose = jnp.asarray([[0, 0, 0, 0, 0, 0, 1, 0, 4.0]], jnp.float32)
    _, intrinsics = decode_pose(pose, (100, 200))
    assert np.isinf(intrinsics[0, 1, 1])
    assert intrinsics[0, 0, 0] < 0
    assert np.allclose(encode_pose(jnp.eye(3, 4)[None], intrinsics, (100, 200))[0, 7:], [0, 4.0], atol=1e-6)
