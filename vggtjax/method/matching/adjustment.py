"""Robust adjustment of cameras and depths to dense matches of a static world (not in the papers).

Gauss-Newton over one pose a frame and one inverse depth a patch, with priors around the first pass's. Depths are
eliminated by the Schur complement: every patch connects its frame with those it is matched with, so a step costs S
times a constant, and a solve over the 6 S parameters of the cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vggtjax.cameras import Cameras
from vggtjax.method.matching.matches import frame_pairs, patch_centres
from vggtjax.network.heads.pose import quaternion_to_matrix
from vggtjax.network.precision import full_precision

_Result = TypeVar("_Result")

_NEAREST = 0.01  # depth over the depth in the other frame; points behind a camera are projected as if they were here
_IN_FRONT = 0.05  # points nearer than this have no weight
_LARGEST_STEP = 0.5  # of a log inverse depth
_LARGEST_ZOOM = 0.1  # of a log focal length
_LEAST_INFORMATION = 1e-9
_AT_ONCE = 1 << 18  # matches whose derivatives are in memory


@dataclass(frozen=True)
class Adjustment:
    """How cameras and depths are adjusted. Lengths in the picture are in patches, in the world in median depths."""

    sigma: float = 0.375  # of the Geman-McClure loss
    annealed: tuple[float, ...] = (2.0, 1.5, 1, 1, 1, 1, 1, 1)  # factor of sigma in each iteration; none: no iteration
    depth_prior: float = 0.15  # standard deviation of a log depth from its prior
    rotation_prior: float = float(np.radians(6))
    translation_prior: float = 0.1
    focal_prior: float | None = None  # of the log of one factor of all focal lengths; None: intrinsics stay
    fixed_cameras: bool = False  # only depths move
    damping: float = 1e-3  # of Levenberg and Marquardt, relative to the diagonal; less moves on where little is known


class Static(NamedTuple):
    """A static world and its differences from the matches."""

    camera_from_world: Float[Array, "S 3 4"]
    depth: Float[Array, "S P"]
    position: Float[Array, "S M P 2"]  # where a static world shows each patch in the other frames, in patches
    in_front: Float[Array, "S M P"]  # depth in the other frame over the depth in its own
    focal: Float[Array, ""]  # factor of all focal lengths
    information: Float[Array, "S P"]  # inverse variance of each log depth by the matches alone, cameras given
    pull: Float[Array, "S P"]  # what the matches alone would add to each log depth, against its prior


class _Problem(NamedTuple):
    """What does not change while cameras and depths are adjusted."""

    matched: Float[Array, "S M P 2"]
    weight: Float[Array, "S M P"]
    mean: Float[Array, "S P"]  # of the prior of the log inverse depths
    focal: Float[Array, "S 1 2"]
    centre: Float[Array, "S 1 2"]
    others: Int[np.ndarray, "S M"]  # frames that see the patches of each
    grid: tuple[int, int]
    how: Adjustment

    @property
    def seen_by(self) -> Int[np.ndarray, "S N"]:
        """The cameras that a patch connects: its own frame's first, N = M + 1."""
        return np.concatenate([np.arange(len(self.others))[:, None], self.others], axis=1)


class _State(NamedTuple):
    rotation: Float[Array, "S 3 3"]
    translation: Float[Array, "S 3"]  # in units of the median depth
    log_inverse: Float[Array, "S P"]  # log of inverse depths
    log_focal: Float[Array, ""]
    moved: Float[Array, "S 6"]  # all steps of the cameras


class _Seen(NamedTuple):
    """The patches of one frame in the M others, over their depth in it, and their differences from the matches."""

    rays: Float[Array, "P 3"]
    turn: Float[Array, "M 3 3"]
    points: Float[Array, "M P 3"]
    position: Float[Array, "M P 2"]
    error: Float[Array, "M P 2"]
    slope: Float[Array, "M P 2 3"]  # of the position by the point
    by_depth: Float[Array, "M P 2"]  # of the position by the log of the inverse depth
    weight: Float[Array, "M P"]


class _Equations(NamedTuple):
    """Normal equations of one frame's patches in its own camera, first, and those of the M others: N = M + 1."""

    blocks: Float[Array, "N N 6 6"]
    gradient: Float[Array, "N 6"]
    cross: Float[Array, "P N 6"]  # of depths and cameras
    depth_curvature: Float[Array, " P"]
    depth_slope: Float[Array, " P"]
    focal_cross: Float[Array, " P"]  # of depths and the focal length
    focal_cameras: Float[Array, "N 6"]
    focal_curvature: Float[Array, ""]
    focal_slope: Float[Array, ""]


@full_precision()
def adjust(
    depth: Float[Array, "S P"],
    cameras: Cameras,
    matched: Float[Array, "S M P 2"],
    weight: Float[Array, "S M P"],
    grid: tuple[int, int],
    how: Adjustment = Adjustment(),
    prior_depth: Float[Array, "S P"] | None = None,
) -> Static:
    """Return the cameras and depths of a clip for which static patches are seen where they are matched.

    Pure and differentiable. The first camera and all principal points stay.

    Args:
        depth: of the centre of every patch, positive: where the adjustment starts.
        cameras: of the S frames; intrinsics in patches.
        matched: x and y of the match of every patch in the other frames, in patches.
        weight: of every match, at least 0; 0 for frames that do not exist.
        grid: rows and columns of patches.
        how: priors, loss and iterations.
        prior_depth: the mean of the prior of `depth`; `depth` itself if None.
    """
    S = len(depth)
    prior_depth = depth if prior_depth is None else prior_depth
    (depth, cameras, matched, weight) = jax.tree.map(jnp.asarray, (depth, cameras, matched, weight))
    unit = jnp.median(prior_depth)
    K = cameras.intrinsics
    focal, centre = K[:, [0, 1], [0, 1]][:, None], K[:, :2, 2][:, None]
    mean = -jnp.log(prior_depth / unit)
    problem = _Problem(matched, weight, mean, focal, centre, frame_pairs(S).others, grid, how)
    rotation, translation = cameras.camera_from_world[..., :3], cameras.camera_from_world[..., 3] / unit
    still = jnp.concatenate([0 * translation, 0 * translation], axis=-1)  # on several devices, as the others are
    state = _State(rotation, translation, -jnp.log(depth / unit), 0 * unit, still)
    sigmas = how.sigma * jnp.array(how.annealed, K.dtype)
    state, _ = jax.lax.scan(lambda state, sigma: (_step(problem, state, sigma), None), state, sigmas)
    last = jnp.asarray(how.sigma * (how.annealed or (1.0,))[-1], K.dtype)
    outcome = _of_frames(lambda s: _outcome(problem, state, last, s), problem)
    poses = jnp.concatenate([state.rotation, unit * state.translation[..., None]], axis=-1)
    poses = cameras.camera_from_world if how.fixed_cameras else poses
    position, in_front, information, pull = outcome
    depth = unit * jnp.exp(-state.log_inverse)
    return Static(poses, depth, position, in_front, jnp.exp(state.log_focal), information, pull)


def _seen(problem: _Problem, state: _State, sigma: Array, s: Array) -> _Seen:
    """Return where a static world shows the patches of frame `s`; the loss is `sigma` wide."""
    focal, centre, how = problem.focal, problem.centre, problem.how
    inverse, to, factor = jnp.exp(state.log_inverse[s]), jnp.asarray(problem.others)[s], jnp.exp(state.log_focal)
    turn = jnp.einsum("mij,kj->mik", state.rotation[to], state.rotation[s])
    shift = state.translation[to] - jnp.einsum("mij,j->mi", turn, state.translation[s])
    ones = jnp.ones((len(inverse), 1), focal.dtype)
    rays = jnp.concatenate([(patch_centres(problem.grid) - centre[s]) / (focal[s] * factor), ones], axis=-1)
    points = jnp.einsum("mij,pj->mpi", turn, rays) + inverse[None, :, None] * shift[:, None]
    position = points[..., :2] / jnp.maximum(points[..., 2:], _NEAREST) * (focal[to] * factor) + centre[to]
    error = position - problem.matched[s]
    slope = _slope_of_projection(points, focal[to] * factor)
    by_depth = jnp.einsum("mpij,mj->mpi", slope, shift) * inverse[None, :, None]
    loss = (1 + jnp.sum(error * error, axis=-1) / sigma**2) ** -2
    w = jnp.where(points[..., 2] > _IN_FRONT, problem.weight[s] * loss / how.sigma**2, 0)
    return _Seen(rays, turn, points, position, error, slope, by_depth, w)


def _equations(problem: _Problem, state: _State, sigma: Array, s: Array) -> _Equations:
    """Return the equations of frame `s`, without its depths."""
    how = problem.how
    rays, turn, points, position, error, slope, by_depth, w = _seen(problem, state, sigma, s)
    inverse = jnp.exp(state.log_inverse[s])
    by_other = slope @ _slope_of_motion(points, inverse)
    by_own = -slope @ jnp.einsum("mij,pjk->mpik", turn, _slope_of_motion(rays, inverse))
    depth_curvature = jnp.einsum("mp,mpi->p", w, by_depth**2) + how.depth_prior**-2
    depth_slope = jnp.einsum("mp,mpi,mpi->p", w, by_depth, error)
    depth_slope += (state.log_inverse[s] - problem.mean[s]) * how.depth_prior**-2
    own, other = w[..., None, None] * by_own, w[..., None, None] * by_other
    corner, between = jnp.einsum("mpia,mpib->ab", own, by_own), jnp.einsum("mpia,mpib->mab", own, by_other)
    blocks = _local_blocks(corner, between, jnp.einsum("mpia,mpib->mab", other, by_other))
    gradient = _by_cameras(own, other, error)
    cross_own = jnp.einsum("mpia,mpi->pa", own, by_depth)[:, None]
    cross = jnp.concatenate([cross_own, jnp.einsum("mpia,mpi->pma", other, by_depth)], axis=1)
    blocks -= jnp.einsum("pma,pnb->mnab", cross / depth_curvature[:, None, None], cross)
    gradient -= jnp.einsum("pma,p->ma", cross, depth_slope / depth_curvature)
    if how.focal_prior is None:
        none = jnp.zeros((), gradient.dtype)
        of_focal = (jnp.zeros(len(inverse), gradient.dtype), jnp.zeros_like(gradient), none, none)
    else:  # a longer focal length turns the ray inwards, and moves the position outwards
        inwards = jnp.einsum("mpij,mjk,pk->mpi", slope, turn, rays * np.array([[-1.0, -1, 0]], np.float32))
        by_focal = inwards + position - problem.centre[jnp.asarray(problem.others)[s]]
        weighted = w[..., None] * by_focal
        focal_cross = jnp.einsum("mpi,mpi->p", weighted, by_depth)
        of_focal = (
            focal_cross,
            _by_cameras(own, other, by_focal) - jnp.einsum("pma,p->ma", cross, focal_cross / depth_curvature),
            jnp.sum(weighted * by_focal) - jnp.sum(focal_cross**2 / depth_curvature),
            jnp.sum(weighted * error) - jnp.sum(focal_cross * depth_slope / depth_curvature),
        )
    return _Equations(blocks, gradient, cross, depth_curvature, depth_slope, *of_focal)


def _by_cameras(
    own: Float[Array, "M P 2 6"], other: Float[Array, "M P 2 6"], values: Float[Array, "M P 2"]
) -> Float[Array, "N 6"]:
    """Return the sums of values in the picture by the motion of the own camera, first, and of the M others."""
    return jnp.concatenate([jnp.einsum("mpia,mpi->a", own, values)[None], jnp.einsum("mpia,mpi->ma", other, values)])


def _step(problem: _Problem, state: _State, sigma: Array) -> _State:
    """Return the state after one step of Gauss and Newton."""
    of = _of_frames(lambda s: _equations(problem, state, sigma, s), problem)
    change, by_focal = _change(of, problem, state)
    by_cameras = jnp.einsum("spma,sma->sp", of.cross, change[problem.seen_by])
    deeper = -(of.depth_slope + by_cameras + of.focal_cross * by_focal) / of.depth_curvature
    turned = quaternion_to_matrix(jnp.concatenate([change[:, :3] / 2, jnp.ones_like(change[:, :1])], axis=-1))
    translation = jnp.einsum("sij,sj->si", turned, state.translation) + change[:, 3:]
    log_inverse = state.log_inverse + jnp.clip(deeper, -_LARGEST_STEP, _LARGEST_STEP)
    log_focal = state.log_focal + by_focal
    return _State(turned @ state.rotation, translation, log_inverse, log_focal, state.moved + change)


def _outcome(problem: _Problem, state: _State, sigma: Array, s: Array) -> tuple[Array, Array, Array, Array]:
    """Return position, depth in the other frames, information and pull of the patches of frame `s`."""
    world = _seen(problem, state, sigma, s)
    information = jnp.einsum("mp,mpi->p", world.weight, world.by_depth**2)
    pull = jnp.einsum("mp,mpi,mpi->p", world.weight, world.by_depth, world.error)
    return world.position, world.points[..., 2], information, pull / jnp.maximum(information, _LEAST_INFORMATION)


def at_patches(depth: Float[Array, "B S H W"], grid: tuple[int, int]) -> Float[Array, "B S P"]:
    """Return the depth of the centre of every patch."""
    B, S, H, _ = depth.shape
    h, w = grid
    side = H // h
    middle = slice((side - 1) // 2, side // 2 + 1)
    return depth.reshape(B, S, h, side, w, side)[:, :, :, middle, :, middle].mean(axis=(3, 5)).reshape(B, S, h * w)


def _of_frames(function: Callable[[Array], _Result], problem: _Problem) -> _Result:
    """Return the function of every frame's index, of all at once where their matches are few."""
    S, M, P = problem.weight.shape
    at_once = max(1, _AT_ONCE // (M * P))
    return (
        jax.vmap(function)(jnp.arange(S)) if at_once >= S else jax.lax.map(function, jnp.arange(S), batch_size=at_once)
    )


def _change(of: _Equations, problem: _Problem, state: _State) -> tuple[Float[Array, "S 6"], Array]:
    """Return the step of every camera, 0 for the first, and of the log focal length, by the damped normal equations.

    Each array of `of` has a leading axis of the S frames.
    """
    S, how, seen_by = len(of.gradient), problem.how, problem.seen_by
    prior = jnp.repeat(jnp.array([how.rotation_prior, how.translation_prior], of.gradient.dtype) ** -2.0, 3)
    is_free = np.arange(6 * S) >= (6 * S if how.fixed_cameras else 6)
    H = jnp.zeros((S, S, 6, 6), of.blocks.dtype).at[seen_by[:, :, None], seen_by[:, None, :]].add(of.blocks)
    H = H.swapaxes(1, 2).reshape(6 * S, 6 * S) + jnp.diag(jnp.tile(prior, S))
    g = (jnp.zeros((S, 6), of.blocks.dtype).at[seen_by].add(of.gradient) + prior[None] * state.moved).ravel()
    g = jnp.where(is_free, g, 0)
    H = jnp.where(is_free[:, None] & is_free[None], H, jnp.eye(6 * S, dtype=H.dtype))
    if how.focal_prior is not None:
        column = jnp.zeros((S, 6), H.dtype).at[seen_by].add(of.focal_cameras).ravel() * is_free
        corner = jnp.sum(of.focal_curvature) + how.focal_prior**-2
        H = jnp.block([[H, column[:, None]], [column[None], corner[None, None]]])
        g = jnp.append(g, jnp.sum(of.focal_slope) + state.log_focal * how.focal_prior**-2)
    H += how.damping * jnp.diag(jnp.diag(H))
    change = -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(H), g)
    by_focal = 0 * state.log_focal if how.focal_prior is None else jnp.clip(change[-1], -_LARGEST_ZOOM, _LARGEST_ZOOM)
    return change[: 6 * S].reshape(S, 6), by_focal


def _local_blocks(
    own: Float[Array, "6 6"], between: Float[Array, "M 6 6"], other: Float[Array, "M 6 6"]
) -> Float[Array, "N N 6 6"]:
    """Return the blocks of N = M + 1 cameras: own first; the others are connected with it, not with each other."""
    M = len(between)
    itself = np.arange(M + 1)
    blocks = jnp.zeros((M + 1, M + 1, 6, 6), own.dtype).at[itself, itself].set(jnp.concatenate([own[None], other]))
    return blocks.at[0, 1:].set(between).at[1:, 0].set(between.swapaxes(-1, -2))


def _slope_of_projection(points: Float[Array, "M P 3"], focal: Float[Array, "M 1 2"]) -> Float[Array, "M P 2 3"]:
    """Return the derivative of the projected position by the point."""
    z = jnp.maximum(points[..., 2], _NEAREST)[..., None]
    straight = jnp.einsum("mpi,ij->mpij", focal / z, jnp.eye(2, 3, dtype=z.dtype))
    return straight - jnp.pad((focal * points[..., :2] / z**2)[..., None], (*((0, 0),) * 3, (2, 0)))


def _slope_of_motion(points: Float[Array, "*N 3"], inverse: Float[Array, "*N"]) -> Float[Array, "*N 3 6"]:
    """Return the derivative of a point over its depth by a small rotation and translation of its camera."""
    inverse = jnp.broadcast_to(inverse, points.shape[:-1])
    x, y, z, zero = *jnp.moveaxis(points, -1, 0), jnp.zeros_like(inverse)
    rows = ([zero, z, -y, inverse, zero, zero], [-z, zero, x, zero, inverse, zero], [y, -x, zero, zero, zero, inverse])
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
