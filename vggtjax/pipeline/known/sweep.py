"""How alike frames look at several multiples of the predicted depth: a plane sweep with the surface as plane.

Collins (1996) sweeps planes; here every pixel is carried to other frames at a multiple of its own depth, and its
neighbourhood is compared there by normalised cross-correlation.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from vggtjax.network.heads.sampling import bilinear

_RADIUS = 2  # of the neighbourhood, in pixels
_NOISE = 1e-4  # variance of grey values; neighbourhoods of less show nothing
_UNSEEN = -0.2  # correlation where the other frame does not show the pixel, but would at the predicted depth
_OFFSETS = (2, 1, 4, 3, 6, 8, 5, 7)  # to the other frames, in the order in which they are taken
_NEAREST = 1e-6  # depth of a point that is in front of a camera


class Views(NamedTuple):
    """Frames with cameras in one world, and the pixels that show something static."""

    images: Float[np.ndarray, "S H W"]  # grey, in [0, 1]
    depth: Float[np.ndarray, "S H W"]
    intrinsics: Float[np.ndarray, "S 3 3"]
    camera_from_world: Float[np.ndarray, "S 3 4"]
    usable: Bool[np.ndarray, "S H W"]


def sweep_costs(views: Views, factors: Float[np.ndarray, " F"], others: int) -> Float32[np.ndarray, "S F H W"]:
    """Return 1 - the correlation of every pixel's neighbourhood with other frames, for each factor of its depth.

    Of up to `others` other frames, near and less near, the better half counts, as the others may be occluded. Frames
    that do not show a pixel at its predicted depth say nothing about it: their correlation is 0 for every factor.
    """
    frames = len(views.images)
    arrays = tuple(jnp.asarray(x, jnp.float32) for x in views[:4])
    usable, wanted = jnp.asarray(views.usable), jnp.asarray(factors, jnp.float32)
    chosen = _others(frames, others)
    return np.stack([np.asarray(_costs(*arrays, usable, wanted, i, jnp.asarray(chosen[i]))) for i in range(frames)])


def _others(frames: int, count: int) -> list[Int[np.ndarray, " N"]]:
    """Return the frames that each frame is compared with, equally many for all, so that one program serves."""
    offsets = [sign * offset for offset in _OFFSETS for sign in (1, -1)]
    lists = [[i + offset for offset in offsets if 0 <= i + offset < frames] for i in range(frames)]
    return [np.array(others[: min(count, *map(len, lists))]) for others in lists]


@jax.jit
def _costs(
    images: Float[Array, "S H W"],
    depth: Float[Array, "S H W"],
    K: Float[Array, "S 3 3"],
    poses: Float[Array, "S 3 4"],
    usable: Bool[Array, "S H W"],
    factors: Float[Array, " F"],
    frame: Int[Array, ""],
    others: Int[Array, " N"],
) -> Float[Array, "F H W"]:
    H, W = depth.shape[1:]
    u, v = jnp.arange(W)[None] + 0.5, jnp.arange(H)[:, None] + 0.5
    own_K, own = K[frame], images[frame]
    right, down = (u - own_K[0, 2]) / own_K[0, 0], (v - own_K[1, 2]) / own_K[1, 1]
    points = jnp.stack([right * depth[frame], down * depth[frame], depth[frame]])  # [3, H, W]
    mean, variance = _moments(own)

    def with_other(other: Array) -> Array:
        turn = jnp.matmul(poses[other, :, :3], poses[frame, :, :3].T, precision="highest")
        shift = poses[other, :, 3] - jnp.matmul(turn, poses[frame, :, 3], precision="highest")
        turned = jnp.einsum("ij,jhw->ihw", turn, points, precision="highest")

        def landed(factor: Array | float) -> tuple[Array, Array, Array]:
            x, y, z = factor * turned + shift[:, None, None]
            away = jnp.maximum(z, _NEAREST)
            column = x / away * K[other, 0, 0] + K[other, 0, 2] - 0.5
            row = y / away * K[other, 1, 1] + K[other, 1, 2] - 0.5
            return column, row, (z > _NEAREST) & (column >= 0) & (column <= W - 1) & (row >= 0) & (row <= H - 1)

        as_predicted = landed(1.0)[2]

        def with_factor(factor: Array) -> Array:
            column, row, seen = landed(factor)
            there, static = _sampled(images[other], usable[other], column, row)
            their_mean, their_variance = _moments(there)
            correlation = (_box(own * there) - mean * their_mean) / jnp.sqrt(variance * their_variance)
            return jnp.where(as_predicted, jnp.where(seen & static, correlation, _UNSEEN), 0)

        return jax.vmap(with_factor)(factors)

    correlations = jnp.sort(jax.lax.map(with_other, others), axis=0)
    return 1 - correlations[len(others) // 2 :].mean(axis=0)


def _sampled(
    image: Float[Array, "H W"], usable: Bool[Array, "H W"], column: Float[Array, "H W"], row: Float[Array, "H W"]
) -> tuple[Float[Array, "H W"], Bool[Array, "H W"]]:
    """Return an image between its pixels (bilinear), and whether the nearest pixel is usable."""
    H, W = image.shape
    column, row = jnp.clip(column, 0, W - 1), jnp.clip(row, 0, H - 1)
    between = bilinear(image[..., None], jnp.stack([column, row], axis=-1))[..., 0]
    return between, usable[jnp.rint(row).astype(int), jnp.rint(column).astype(int)]


def _moments(image: Float[Array, "H W"]) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """Return mean and variance of every pixel's neighbourhood."""
    mean = _box(image)
    return mean, jnp.maximum(_box(image * image) - mean * mean, 0) + _NOISE


def _box(image: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Return the mean over every pixel's neighbourhood; edges continue."""
    side = 2 * _RADIUS + 1
    for axis in (0, 1):
        widths = [(_RADIUS, _RADIUS) if each == axis else (0, 0) for each in (0, 1)]
        padded = jnp.pad(image, widths, mode="edge")
        parts = [jax.lax.slice_in_dim(padded, k, k + image.shape[axis], axis=axis) for k in range(side)]
        image = sum(parts[1:], parts[0]) / side
    return image
