"""Robust adjustment of cameras and depths to dense matches of a static world (not in the papers).

Gauss-Newton over one pose a frame and one inverse depth a patch, with priors around the first pass's. Depths are
eliminated by the Schur complement: every patch connects its frame with those it is matched with, so a step costs S
times a constant, and a solve over the 6 S parameters of the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vggtjax.cameras import Cameras
from vggtjax.method.matches import frame_pairs, patch_centres
from vggtjax.network.pose import quaternion_to_matrix
from vggtjax.network.precision import full_precision

_NEAREST = 0.01  # depth over the depth in the other frame; points behind a camera are projected as if they were here
_IN_FRONT = 0.05  # points nearer than this have no weight
_LARGEST_STEP = 0.5  # of a log inverse depth
_DAMPING = 1e-3  # of Levenberg and Marquardt, relative to the diagonal


@dataclass(frozen=True)
class Adjustment:
    """How cameras and depths are adjusted. Lengths in the picture are in patches, in the world in median depths."""

    sigma: float = 0.375  # of the Geman-McClure loss
    annealed: tuple[float, ...] = (2.0, 1.5, 1, 1, 1, 1, 1, 1)  # sigma is multiplied by this in each iteration
    depth_prior: float = 0.15  # standard deviation of a log depth from the first pass's
    rotation_prior: float = float(np.radians(6))
    translation_prior: float = 0.1


class Static(NamedTuple):
    """A static world and its differences from the matches."""

    camera_from_world: Float[Array, "S 3 4"]
    depth: Float[Array, "S P"]
    position: Float[Array, "S M P 2"]  # where a static world shows each patch in the other frames, in patches
    in_front: Float[Array, "S M P"]  # depth in the other frame over the depth in its own


@full_precision
def adjust(
    depth: Float[Array, "S P"],
    cameras: Cameras,
    matched: Float[Array, "S M P 2"],
    weight: Float[Array, "S M P"],
    grid: tuple[int, int],
    how: Adjustment = Adjustment(),
) -> Static:
    """Return the cameras and depths of a clip for which static patches are seen where they are matched.

    Pure and differentiable. The first camera and all intrinsics stay.

    Args:
        depth: of the centre of every patch, positive.
        cameras: of the S frames; intrinsics in patches.
        matched: x and y of the match of every patch in the other frames, in patches.
        weight: of every match, at least 0; 0 for frames that do not exist.
        grid: rows and columns of patches.
        how: priors, loss and iterations.
    """
    S, P = depth.shape
    unit = jnp.median(depth)
    rotation, translation = cameras.camera_from_world[..., :3], cameras.camera_from_world[..., 3] / unit
    start = -jnp.log(depth / unit)
    K = cameras.intrinsics
    focal, centre = K[:, [0, 1], [0, 1]][:, None], K[:, :2, 2][:, None]
    rays = jnp.concatenate([(patch_centres(grid)[None] - centre) / focal, jnp.ones((S, P, 1), K.dtype)], axis=-1)
    others = frame_pairs(S).others
    seen_by = np.concatenate([np.arange(S)[:, None], others], axis=1)  # [S, M + 1], the cameras that a patch connects
    prior = jnp.repeat(jnp.array([how.rotation_prior, how.translation_prior]) ** -2.0, 3)

    def seen(rotation: Array, translation: Array, inverse: Array) -> tuple[Array, Array, Array]:
        """Return each patch in the other frames, over its depth in its own; and the motions between the frames."""
        turn = jnp.einsum("smij,skj->smik", rotation[others], rotation)
        shift = translation[others] - jnp.einsum("smij,sj->smi", turn, translation)
        points = jnp.einsum("smij,spj->smpi", turn, rays) + inverse[:, None, :, None] * shift[:, :, None]
        return points, turn, shift

    def projected(points: Float[Array, "S M P 3"]) -> Float[Array, "S M P 2"]:
        z = jnp.maximum(points[..., 2:], _NEAREST)
        return points[..., :2] / z * focal[others] + centre[others]

    def step(state: tuple[Array, ...], sigma: Array) -> tuple[tuple[Array, ...], None]:
        rotation, translation, log_inverse, moved = state
        inverse = jnp.exp(log_inverse)
        points, turn, shift = seen(rotation, translation, inverse)
        error = projected(points) - matched
        slope = _slope_of_projection(points, focal[others])  # [S, M, P, 2, 3]
        by_other = slope @ _slope_of_motion(points, inverse[:, None])
        by_own = -slope @ jnp.einsum("smij,spjk->smpik", turn, _slope_of_motion(rays, inverse))
        by_depth = jnp.einsum("smpij,smj->smpi", slope, shift) * inverse[:, None, :, None]
        loss = (1 + jnp.sum(error * error, axis=-1) / sigma**2) ** -2
        w = jnp.where(points[..., 2] > _IN_FRONT, weight * loss / how.sigma**2, 0)  # [S, M, P]
        depth_curvature = jnp.einsum("smp,smpi->sp", w, by_depth**2) + how.depth_prior**-2
        depth_slope = jnp.einsum("smp,smpi,smpi->sp", w, by_depth, error)
        depth_slope += (log_inverse - start) * how.depth_prior**-2
        # Of every frame, the normal equations of its own camera and those of the frames it is matched with.
        own, other = w[..., None, None] * by_own, w[..., None, None] * by_other
        between = jnp.einsum("smpia,smpib->smab", own, by_other)
        corner = jnp.einsum("smpia,smpib->sab", own, by_own)
        blocks = _local_blocks(corner, between, jnp.einsum("smpia,smpib->smab", other, by_other))
        slope_own, slope_other = jnp.einsum("smpia,smpi->sa", own, error), jnp.einsum("smpia,smpi->sma", other, error)
        gradient = jnp.concatenate([slope_own[:, None], slope_other], axis=1)  # [S, M + 1, 6]
        cross_own = jnp.einsum("smpia,smpi->spa", own, by_depth)[:, :, None]
        cross = jnp.concatenate([cross_own, jnp.einsum("smpia,smpi->spma", other, by_depth)], axis=2)
        blocks -= jnp.einsum("spma,spnb->smnab", cross / depth_curvature[..., None, None], cross)
        gradient -= jnp.einsum("spma,sp->sma", cross, depth_slope / depth_curvature)
        change = _change(blocks, gradient, seen_by, prior, moved)
        deeper = -(depth_slope + jnp.einsum("spma,sma->sp", cross, change[seen_by])) / depth_curvature
        turned = quaternion_to_matrix(jnp.concatenate([change[:, :3] / 2, jnp.ones_like(change[:, :1])], axis=-1))
        translation = jnp.einsum("sij,sj->si", turned, translation) + change[:, 3:]
        log_inverse += jnp.clip(deeper, -_LARGEST_STEP, _LARGEST_STEP)
        return (turned @ rotation, translation, log_inverse, moved + change), None

    still = jnp.concatenate([0 * translation, 0 * translation], axis=-1)  # on several devices, as the others are
    state = (rotation, translation, start, still)
    (rotation, translation, log_inverse, _), _ = jax.lax.scan(step, state, how.sigma * jnp.array(how.annealed))
    points, _, _ = seen(rotation, translation, jnp.exp(log_inverse))
    poses = jnp.concatenate([rotation, unit * translation[..., None]], axis=-1)
    return Static(poses, unit * jnp.exp(-log_inverse), projected(points), points[..., 2])


def at_patches(depth: Float[Array, "B S H W"], grid: tuple[int, int]) -> Float[Array, "B S P"]:
    """Return the depth of the centre of every patch."""
    B, S, H, _ = depth.shape
    h, w = grid
    side = H // h
    middle = slice((side - 1) // 2, side // 2 + 1)
    return depth.reshape(B, S, h, side, w, side)[:, :, :, middle, :, middle].mean(axis=(3, 5)).reshape(B, S, h * w)


def _change(
    blocks: Float[Array, "S N N 6 6"], gradient: Float[Array, "S N 6"], seen_by: np.ndarray, prior: Array, moved: Array
) -> Float[Array, "S 6"]:
    """Return the step of every camera by the damped normal equations, summed over the frames; 0 for the first."""
    S = len(gradient)
    is_free = np.arange(6 * S) >= 6
    H = jnp.zeros((S, S, 6, 6), blocks.dtype).at[seen_by[:, :, None], seen_by[:, None, :]].add(blocks)
    H = H.swapaxes(1, 2).reshape(6 * S, 6 * S) + jnp.diag(jnp.tile(prior, S))
    g = (jnp.zeros((S, 6), blocks.dtype).at[seen_by].add(gradient) + prior[None] * moved).ravel() * is_free
    H = jnp.where(is_free[:, None] & is_free[None], H, np.eye(6 * S))
    H += _DAMPING * jnp.diag(jnp.diag(H))
    return -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(H), g).reshape(S, 6)


def _local_blocks(
    own: Float[Array, "S 6 6"], between: Float[Array, "S M 6 6"], other: Float[Array, "S M 6 6"]
) -> Float[Array, "S N N 6 6"]:
    """Return the blocks of N = M + 1 cameras: own first; the others are connected with it, not with each other."""
    M = between.shape[1]
    diagonal = jnp.concatenate([own[:, None], other], axis=1)
    itself = np.arange(M + 1)
    blocks = jnp.zeros((len(own), M + 1, M + 1, 6, 6), own.dtype).at[:, itself, itself].set(diagonal)
    return blocks.at[:, 0, 1:].set(between).at[:, 1:, 0].set(between.swapaxes(-1, -2))


def _slope_of_projection(points: Float[Array, "S M P 3"], focal: Float[Array, "S M 1 2"]) -> Float[Array, "S M P 2 3"]:
    """Return the derivative of the projected position by the point."""
    z = jnp.maximum(points[..., 2], _NEAREST)[..., None]
    straight = jnp.einsum("smpi,ij->smpij", focal / z, jnp.eye(2, 3))
    return straight - jnp.pad((focal * points[..., :2] / z**2)[..., None], (*((0, 0),) * 4, (2, 0)))


def _slope_of_motion(points: Float[Array, "*N 3"], inverse: Float[Array, "*N"]) -> Float[Array, "*N 3 6"]:
    """Return the derivative of a point over its depth by a small rotation and translation of its camera."""
    inverse = jnp.broadcast_to(inverse, points.shape[:-1])
    x, y, z, zero = *jnp.moveaxis(points, -1, 0), jnp.zeros_like(inverse)
    rows = ([zero, z, -y, inverse, zero, zero], [-z, zero, x, zero, inverse, zero], [y, -x, zero, zero, zero, inverse])
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
