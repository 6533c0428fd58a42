"""Differentiable distances between predictions and the truth: camera poses and point clouds."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.network.precision import full_precision

QUERIES_AT_ONCE = 64
_TINY = 1e-12


class PoseError(NamedTuple):
    """Errors of cameras relative to the first camera."""

    rotation: Float[Array, ""]  # radians, root mean square over frames
    translation: Float[Array, ""]  # RMSE of the centres over the root mean square of the true ones, after one scale


@full_precision()
def pose_error(found: Float[Array, "S 3 4"], truth: Float[Array, "S 3 4"]) -> PoseError:
    """Return the errors of cameras (camera_from_world), each relative to the first frame; at least two frames.

    Differentiable; the gradient at an error of 0 is 0.
    """
    rotations, centres = zip(*(_relative(poses) for poses in (found, truth)), strict=True)
    difference = jnp.einsum("sij,sik->sjk", rotations[0], rotations[1])
    sine = (difference - difference.mT)[:, [2, 0, 1], [1, 2, 0]]
    cosine = jnp.trace(difference, axis1=1, axis2=2) - 1
    angle = jnp.arctan2(jnp.sqrt(jnp.sum(sine * sine, axis=-1) + _TINY**2), cosine)
    size = jnp.sum(centres[0] * centres[0])
    scale = jnp.maximum(jnp.sum(centres[0] * centres[1]) / jnp.maximum(size, _TINY), 0)
    apart = jnp.sum((scale * centres[0] - centres[1]) ** 2) / jnp.maximum(jnp.sum(centres[1] ** 2), _TINY)
    return PoseError(_root(jnp.mean(angle * angle)), _root(apart))


def point_cloud_distance(found: Float[Array, "N 3"], truth: Float[Array, "M 3"]) -> Float[Array, ""]:
    """Return the Chamfer distance: the mean distance to the other cloud's nearest point, averaged over both ways."""
    ways = ((found, truth), (truth, found))
    return sum((nearest_distance(points, others).mean() for points, others in ways), jnp.zeros(())) / 2


@full_precision()
def nearest_distance(points: Float[Array, "N 3"], others: Float[Array, "M 3"]) -> Float[Array, " N"]:
    """Return every point's distance to the nearest of the others, differentiable by both clouds.

    Exact: all pairs are compared, 64 points at a time, so memory grows with M. No gradient passes through the choice of
    the nearest point.
    """
    fixed = jax.lax.stop_gradient(others)

    def nearest(query: Array) -> Array:
        return jnp.argmin(jnp.sum((fixed - query[None]) ** 2, axis=-1))

    index = jax.lax.map(nearest, jax.lax.stop_gradient(points), batch_size=QUERIES_AT_ONCE)
    return jnp.sqrt(jnp.sum((points - others[index]) ** 2, axis=-1) + _TINY**2)


def _relative(poses: Float[Array, "S 3 4"]) -> tuple[Float[Array, "S 3 3"], Float[Array, "S 3"]]:
    """Return rotations relative to the first frame, and centres relative to it in its axes."""
    rotation = poses[..., :3]
    centres = -jnp.einsum("sji,sj->si", rotation, poses[..., 3])
    return (
        jnp.einsum("sij,kj->sik", rotation, rotation[0]),
        jnp.einsum("ij,sj->si", rotation[0], centres - centres[:1]),
    )


def _root(square: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.sqrt(square + _TINY**2)
