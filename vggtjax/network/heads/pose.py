"""The pose encoding [t(3), quaternion xyzw(4), fov_h, fov_w] <-> camera matrices (VGGT, OpenCV convention)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

POSE_SIZE = 9


def decode_pose(
    pose_encoding: Float[Array, "... 9"], size: tuple[int, int]
) -> tuple[Float[Array, "... 3 4"], Float[Array, "... 3 3"]]:
    """Return camera_from_world [..., 3, 4] and intrinsics [..., 3, 3] in pixels of an image of `size` (H, W).

    The quaternion can have any length. Exact for any field of view: 0 gives an infinite focal length, more than pi a
    negative one; nothing is clamped.
    """
    translation, quaternion = pose_encoding[..., :3], pose_encoding[..., 3:7]
    camera_from_world = jnp.concatenate([quaternion_to_matrix(quaternion), translation[..., None]], axis=-1)
    H, W = size
    focal_y = (H / 2) / jnp.tan(pose_encoding[..., 7] / 2)
    focal_x = (W / 2) / jnp.tan(pose_encoding[..., 8] / 2)
    zero, one = jnp.zeros_like(focal_x), jnp.ones_like(focal_x)
    intrinsics = jnp.stack(
        [focal_x, zero, one * (W / 2), zero, focal_y, one * (H / 2), zero, zero, one], axis=-1
    ).reshape(*focal_x.shape, 3, 3)
    return camera_from_world, intrinsics


def encode_pose(
    camera_from_world: Float[Array, "... 3 4"], intrinsics: Float[Array, "... 3 3"], size: tuple[int, int]
) -> Float[Array, "... 9"]:
    """Return the pose encoding of cameras: the inverse of `decode_pose` up to the quaternion's length and sign.

    The quaternion has unit length and w >= 0. The principal point is assumed at the image centre.
    """
    H, W = size
    fov_h = 2 * jnp.arctan2(jnp.asarray(H / 2), intrinsics[..., 1, 1])
    fov_w = 2 * jnp.arctan2(jnp.asarray(W / 2), intrinsics[..., 0, 0])
    quaternion = matrix_to_quaternion(camera_from_world[..., :3])
    return jnp.concatenate([camera_from_world[..., 3], quaternion, fov_h[..., None], fov_w[..., None]], axis=-1)


def inverted_pose(pose_encoding: Float[Array, "... 9"]) -> Float[Array, "... 9"]:
    """Return the encoding of the inverse: world-to-camera of camera-to-world, and the other way round."""
    translation, quaternion = pose_encoding[..., :3], pose_encoding[..., 3:7]
    inverse = jnp.concatenate([-quaternion[..., :3], quaternion[..., 3:]], axis=-1)
    moved = -jnp.einsum("...ij,...j->...i", quaternion_to_matrix(inverse), translation)
    return jnp.concatenate([moved, inverse, pose_encoding[..., 7:]], axis=-1)


def quaternion_to_matrix(quaternion: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Return the rotation of a quaternion xyzw of any length but 0."""
    x, y, z, w = jnp.moveaxis(quaternion, -1, 0)
    s = 2 / jnp.sum(quaternion * quaternion, axis=-1)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(rotation: Float[Array, "... 3 3"]) -> Float[Array, "... 4"]:
    """Return the unit quaternion xyzw with w >= 0 of a rotation.

    Each of the four solutions divides by another component. The largest divisor is chosen, so the result and its
    gradient are stable everywhere.
    """
    r = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    squares = jnp.stack(  # 4 x^2, 4 y^2, 4 z^2, 4 w^2
        [
            1 + r[0][0] - r[1][1] - r[2][2],
            1 - r[0][0] + r[1][1] - r[2][2],
            1 - r[0][0] - r[1][1] + r[2][2],
            1 + r[0][0] + r[1][1] + r[2][2],
        ],
        axis=-1,
    )
    xy, xz, yz = r[1][0] + r[0][1], r[0][2] + r[2][0], r[2][1] + r[1][2]  # 4 x y, ...
    xw, yw, zw = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    products = [
        [squares[..., 0], xy, xz, xw],
        [xy, squares[..., 1], yz, yw],
        [xz, yz, squares[..., 2], zw],
        [xw, yw, zw, squares[..., 3]],
    ]
    products = jnp.stack([jnp.stack(row, axis=-1) for row in products], axis=-2)  # 4 q q^T
    largest = jnp.argmax(squares, axis=-1)[..., None, None]
    quaternion = jnp.take_along_axis(products, largest, axis=-2)[..., 0, :]
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    return jnp.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
