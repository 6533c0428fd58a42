"""Intervals of rays inside convex shapes. Arrays are [components, pixels], which vectorises over pixels."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

Interval = tuple[Float[Array, "K P"], Float[Array, "K P"]]
_TINY = 1e-9  # a ray parallel to a face is turned by this much


def slabs(origin: Array, direction: Array, low: Array | float, high: Array | float) -> tuple[Array, Array]:
    """Return where rays enter and leave slabs between two planes, for every coordinate by itself."""
    step = jnp.where(jnp.abs(direction) < _TINY, _TINY, direction)
    first, second = (low - origin) / step, (high - origin) / step
    return jnp.minimum(first, second), jnp.maximum(first, second)


def box(origin: Float[Array, "K 3 #P"], direction: Float[Array, "K 3 P"], size: Float[Array, "K 3"]) -> Interval:
    """Return where rays enter and leave boxes of half extents `size`; rays that miss leave before they enter."""
    near, far = slabs(origin, direction, -size[..., None], size[..., None])
    return near.max(axis=-2), far.min(axis=-2)


def ellipsoid(origin: Float[Array, "K 3 #P"], direction: Float[Array, "K 3 P"], size: Float[Array, "K 3"]) -> Interval:
    """Return where rays enter and leave ellipsoids of semi-axes `size`."""
    o, d = origin / size[..., None], direction / size[..., None]
    return _quadratic((d * d).sum(axis=-2), (o * d).sum(axis=-2), (o * o).sum(axis=-2) - 1)


def cylinder(origin: Float[Array, "K 3 #P"], direction: Float[Array, "K 3 P"], size: Float[Array, "K 3"]) -> Interval:
    """Return where rays enter and leave capped cylinders along y: radii size[0] and size[2], half height size[1]."""
    o, d = origin / size[..., None], direction / size[..., None]
    a = d[..., 0, :] ** 2 + d[..., 2, :] ** 2
    b = o[..., 0, :] * d[..., 0, :] + o[..., 2, :] * d[..., 2, :]
    c = o[..., 0, :] ** 2 + o[..., 2, :] ** 2 - 1
    side_in, side_out = _quadratic(jnp.maximum(a, _TINY), b, c)
    caps_in, caps_out = slabs(o[..., 1, :], d[..., 1, :], -1, 1)
    return jnp.maximum(side_in, caps_in), jnp.minimum(side_out, caps_out)


def box_normal(point: Float[Array, "3 P"], size: Float[Array, "3 P"]) -> Float[Array, "3 P"]:
    """Return the outward normal at a point of a box's surface."""
    share = point / size
    face = jnp.argmax(jnp.abs(share), axis=0)  # an index, never a comparison of floats that a compiler may round anew
    return jnp.where(jnp.arange(3)[:, None] == face[None], jnp.sign(share), 0)


def ellipsoid_normal(point: Float[Array, "3 P"], size: Float[Array, "3 P"]) -> Float[Array, "3 P"]:
    """Return the outward normal at a point of an ellipsoid's surface."""
    return _unit(point / size**2)


def cylinder_normal(point: Float[Array, "3 P"], size: Float[Array, "3 P"]) -> Float[Array, "3 P"]:
    """Return the outward normal at a point of a capped cylinder's surface."""
    share = point / size
    radial = share[0] ** 2 + share[2] ** 2
    cap = jnp.abs(share[1]) * jnp.abs(share[1]) > radial
    zero = jnp.zeros_like(radial)
    side = _unit(jnp.stack([share[0] / size[0], zero, share[2] / size[2]]))
    return jnp.where(cap[None], jnp.stack([zero, jnp.sign(share[1]), zero]), side)


SHAPES = {  # name -> the interval of a ray inside it, its normal
    "box": (box, box_normal),
    "ellipsoid": (ellipsoid, ellipsoid_normal),
    "cylinder": (cylinder, cylinder_normal),
}


def _quadratic(a: Array, b: Array, c: Array) -> Interval:
    """Return the roots of a t^2 + 2 b t + c; an empty interval without roots."""
    discriminant = b * b - a * c
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    hit = discriminant > 0
    return jnp.where(hit, (-b - root) / a, jnp.inf), jnp.where(hit, (-b + root) / a, -jnp.inf)


def _unit(x: Float[Array, "3 P"]) -> Float[Array, "3 P"]:
    return x / jnp.maximum(jnp.linalg.norm(x, axis=0, keepdims=True), 1e-12)
