"""One surface in place of a layer for each frame: static pixels take the mean depth of the frames that see them.

Each pixel is projected into the frames at a few offsets; where their surface lies near it, their depth there counts in
the mean of log depth, by confidence. What lies further off is another surface: it hides the pixel, or is hidden.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from vggtjax.method.matching.matches import frame_pairs
from vggtjax.network.precision import full_precision
from vggtjax.results.result import Result
from vggtjax.results.visible import inside_box, show_points

_TIMES = 4.0  # the tolerance is so many median differences between frames
_TOLERANCE = (0.01, 0.2)  # of log depth: its range
_COARSE = 3  # pixels; the median difference is taken over every third pixel, both ways
_MOST_WEIGHT = 1e30  # of a confidence: sums of it and of many frames stay finite
_NEAREST = 1e-3  # of depth in the other frame, over that in its own

_AXES = np.array([0, 1])


class Surface(NamedTuple):
    """What a frame says of static surfaces."""

    log_depth: Float[Array, "*M H W"]
    weight: Float[Array, "*M H W"]  # 0 where the depth is unknown or moves
    camera_from_world: Float[Array, "*M 3 4"]
    intrinsics: Float[Array, "*M 3 3"]


class Seen(NamedTuple):
    """What another frame says of a frame's pixels."""

    difference: Float[Array, "*M H W"]  # its log depth there, brought into the frame, minus the frame's own
    weight: Float[Array, "*M H W"]  # its confidence there; 0 where it does not see the pixel


def differences(result: Result, on_frame: Callable[[], object] = lambda: None) -> Float32[np.ndarray, " N"]:
    """Return |log| between the depth of static pixels and that of other frames there, on a coarse raster of pixels."""
    found = [np.zeros(0, np.float32)]
    for frame in range(len(result.depth)):
        seen = _look_around(*_around(result, frame), step=_COARSE)
        found.append(np.abs(np.asarray(seen.difference))[np.asarray(seen.weight) > 0])
        on_frame()
    return np.concatenate(found)


def tolerance_of(differences: Float32[np.ndarray, " N"]) -> float:
    """Return the log difference up to which two frames are taken to see one surface."""
    median = float(np.median(differences)) if len(differences) else 0.0
    return float(np.clip(_TIMES * median, *_TOLERANCE))


def join_frame(
    result: Result, frame: int, tolerance: float
) -> tuple[Float32[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Return what is added to the log depth of a frame's static pixels, and where another frame says something."""
    added, joined = _joined(*_around(result, frame), tolerance)
    return np.asarray(added), np.asarray(joined)


def _around(result: Result, frame: int) -> tuple[Surface, Surface]:
    """Return a frame's surface and those of the frames it is compared with, without weight where there is none."""
    pairs = frame_pairs(len(result.depth))
    own = _surface(result, frame)
    nothing = own._replace(weight=np.zeros_like(own.weight))
    exist = zip(pairs.others[frame].tolist(), pairs.exist[frame], strict=True)
    others = [_surface(result, other) if exists else nothing for other, exists in exist]
    return own, Surface(*(np.stack(values) for values in zip(*others, strict=True)))  # type: ignore[arg-type]


def _surface(result: Result, frame: int) -> Surface:
    depth, confidence = result.depth[frame], result.depth_confidence[frame]
    known = show_points(depth, confidence, inside_box(result.valid_box[frame], depth.shape))
    static = known & ~result.dynamic_mask[frame]
    weight = np.where(static, np.clip(confidence, np.finfo(np.float32).tiny, _MOST_WEIGHT), 0)
    logs = np.log(np.where(known, depth, 1))
    return Surface(logs, weight, result.camera_from_world[frame], result.intrinsics[frame])  # type: ignore[arg-type]


@partial(jax.jit, static_argnames="step")
@full_precision()
def _look_around(own: Surface, others: Surface, step: int) -> Seen:
    return jax.lax.map(lambda other: _look(own, other, step), others)


@jax.jit
@full_precision()
def _joined(own: Surface, others: Surface, tolerance: Float[Array, ""]) -> tuple[Array, Array]:
    def add(sums: tuple[Array, Array], other: Surface) -> tuple[tuple[Array, Array], None]:
        seen = _look(own, other)
        weight = jnp.where(jnp.abs(seen.difference) < tolerance, seen.weight, 0)
        return (sums[0] + weight * seen.difference, sums[1] + weight), None

    nothing = jnp.zeros_like(own.weight)
    (total, weight), _ = jax.lax.scan(add, (nothing, nothing), others)
    return total / jnp.maximum(weight + own.weight, 1e-12), (weight > 0) & (own.weight > 0)


def _look(own: Surface, other: Surface, step: int = 1) -> Seen:
    H, W = own.log_depth.shape
    pixels = jnp.asarray(np.stack(np.meshgrid(np.arange(0, W, step), np.arange(0, H, step)), axis=-1) + np.float32(0.5))
    log_depth = own.log_depth[::step, ::step]
    turn = other.camera_from_world[:, :3] @ own.camera_from_world[:, :3].T
    shift = (other.camera_from_world[:, 3] - turn @ own.camera_from_world[:, 3])[None, None]

    def rays(places: Array, K: Array) -> Array:
        flat = (places - K[None, None, :2, 2]) / K[None, None, _AXES, _AXES]
        return jnp.concatenate([flat, jnp.ones_like(flat[..., :1])], axis=-1)

    depth = jnp.exp(log_depth)
    points = depth[..., None] * (rays(pixels, own.intrinsics) @ turn.T) + shift
    z = points[..., 2]
    K, nearest = other.intrinsics, _NEAREST * depth
    places = points[..., :2] / jnp.maximum(z, nearest)[..., None] * K[None, None, _AXES, _AXES] + K[None, None, :2, 2]
    at = places - 0.5
    corner = jnp.clip(jnp.floor(at).astype(int), 0, np.array([[[W - 2, H - 2]]]))
    inside = jnp.all((at >= 0) & (at <= np.array([[[W - 1, H - 1]]])), axis=-1) & (z > nearest)
    right, down = jnp.moveaxis(jnp.clip(at - corner, 0, 1), -1, 0)
    shares = ((1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right)
    index = corner[..., 1] * W + corner[..., 0]
    found, known, weight = (jnp.zeros_like(z), jnp.ones_like(z, bool), jnp.zeros_like(z))
    for share, move in zip(shares, (0, 1, W, W + 1), strict=True):
        found += share * other.log_depth.reshape(-1)[index + move]
        near = other.weight.reshape(-1)[index + move]
        known, weight = known & (near > 0), weight + share * near
    back = (jnp.exp(found)[..., None] * rays(places, K) - shift) @ turn  # turn^T p
    seen_at = back[..., 2]
    difference = jnp.log(jnp.maximum(seen_at, nearest)) - log_depth
    counts = inside & known & (seen_at > nearest) & (own.weight[::step, ::step] > 0)
    return Seen(jnp.where(counts, difference, 0), jnp.where(counts, weight, 0))
