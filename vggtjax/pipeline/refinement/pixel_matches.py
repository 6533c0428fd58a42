"""Matches of patches made exact by pixels: windows slid over the other frame, by normalised cross-correlation (ZNCC).

A window is sampled in the other frame where the patch is expected, warped so that the patch looks as in its own frame;
the patch's own window is slid over it, to a part of a pixel.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from vggtjax.cameras import Cameras
from vggtjax.method.matching.matches import FramePairs, frame_pairs, patch_centres

_LOWEST, _HIGHEST = 0.4, 0.8  # ZNCC of weight 0, and from which a match has its full weight
_CYCLE = 0.3  # patches; matches that come back further away count little
_CURVATURE = 0.002  # of the ZNCC's peak by the pixel, across its flattest direction, from which a match has full weight
_INSIDE = 0.8  # share of a window that must be inside the picture
_OUTSIDE = -1.0  # score of the others
_NOISE = 1.3e-6  # variance of rounding to 8 bits, for colours in [0, 1]; windows of less show nothing
_MOST_STRETCH = 2.0  # of a window
_MOST_MOVE = 0.75  # pixels by which a parabola moves the best whole shift
_NEAREST = 1e-3  # depth over the median; points behind a camera are projected as if they were here
_LOST = 9.0  # patches; the cycle of what leaves the picture


class Window(NamedTuple):
    """Sizes in pixels: windows of 2 radius + 1 a side, slid by up to reach each way."""

    radius: int
    reach: int


LEAST_WEIGHT = 0.2  # sum of the weights of a patch's matches, from which they count
FEWEST_MATCHED = 0.05  # share of the patches that must have matches that count


class PixelMatches(NamedTuple):
    """Matches of every patch with frames at M offsets."""

    position: Float32[np.ndarray, "S M P 2"]  # x, y in patches
    weight: Float32[np.ndarray, "S M P"]  # in [0, 1]; 0 for frames that do not exist


def match_pixels(
    pictures: Float32[np.ndarray, "S H W"],
    expected: Float32[np.ndarray, "S M P 2"],
    warp: Float32[np.ndarray, "S M P 2 2"],
    grid: tuple[int, int],
    window: Window,
    shown: Float32[np.ndarray, "S 4"] | None = None,
    *,
    strict: bool = False,
) -> PixelMatches:
    """Return the best match of every patch near where it is expected.

    Args:
        pictures: grey, in [0, 1]; H and W are whole numbers of pixels a patch.
        expected: x, y in patches.
        warp: derivative of the position in the other frame by that in the own.
        grid: rows and columns of patches.
        window: sizes.
        shown: left, top, right and bottom of the pictures within their padding, in patches; infinite without.
        strict: leave out matches beside shifts that leave the picture: they are off by up to a pixel. An adjustment
            with a robust loss gains by them.
    """
    pairs = frame_pairs(len(pictures))
    own, offset = np.nonzero(pairs.exist)
    inputs = (own, pairs.others[own, offset], expected[own, offset], warp[own, offset])
    if shown is None:
        shown = np.tile(np.array([-np.inf, -np.inf, np.inf, np.inf], np.float32), (len(pictures), 1))
    side = pictures.shape[1] // grid[0]
    found = _slide(jnp.asarray(pictures), jnp.asarray(shown * side), *map(jnp.asarray, inputs), grid, window, strict)
    S, M, P, _ = expected.shape
    position, score, curvature = expected.copy(), np.zeros((S, M, P), np.float32), np.zeros((S, M, P), np.float32)
    for into, values in zip((position, score, curvature), found, strict=True):
        into[own, offset] = np.asarray(values)
    trust = np.clip((score - _LOWEST) / (_HIGHEST - _LOWEST), 0, 1) * np.clip(curvature / _CURVATURE, 0, 1)
    trust *= np.exp(-((cycles(position, pairs, grid) / _CYCLE) ** 2)) * pairs.exist[:, :, None]
    return PixelMatches(position, trust.astype(np.float32))


@partial(jax.jit, static_argnames=("grid", "window", "strict"))
def _slide(
    pictures: Float[Array, "S H W"],
    shown: Float[Array, "S 4"],
    own: Int[Array, " K"],
    other: Int[Array, " K"],
    expected: Float[Array, "K P 2"],
    warp: Float[Array, "K P 2 2"],
    grid: tuple[int, int],
    window: Window,
    strict: bool,
) -> tuple[Float[Array, "K P 2"], Float[Array, "K P"], Float[Array, "K P"]]:
    """Return positions in patches, their ZNCC (0 where the best shift is at the rim) and curvature of its peak."""
    side, P = pictures.shape[1] // grid[0], grid[0] * grid[1]
    n, shifts = 2 * window.radius + 1, 2 * window.reach + 1
    fine, inner = _offsets(window.radius + window.reach), _offsets(window.radius)
    centres = jnp.asarray(patch_centres(grid) * side)
    size = np.array([[pictures.shape[2:0:-1]]], np.float32)

    def of_pair(pair: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        i, j, expected, warp = pair
        own_places = centres[None] + inner[:, None]  # [n * n, P, 2]
        mine = _sample(pictures[i], own_places)  # [n * n, P]
        mine -= mine.mean(axis=0, keepdims=True)
        own_share = jnp.mean(_is_in(own_places, shown[i]), axis=0)
        places = (expected * side)[None] + jnp.einsum("pab,kb->kpa", warp, fine)
        inside = jnp.all((places > 0) & (places < size), axis=-1) & _is_in(places, shown[j])
        theirs = jnp.stack([_sample(pictures[j], places), inside.astype(jnp.float32)])
        theirs = theirs.reshape(2, n + shifts - 1, n + shifts - 1, P)

        def add(place: Array, sums: tuple[Array, ...]) -> tuple[Array, ...]:
            start = (0, place // n, place % n, 0)
            colour, inside = jax.lax.dynamic_slice(theirs, start, (2, shifts, shifts, P))
            product, total, square, share = sums
            return product + colour * mine[place][None, None], total + colour, square + colour**2, share + inside

        zeros = (jnp.zeros((shifts, shifts, P)),) * 4
        product, total, square, share = jax.lax.fori_loop(0, n * n, add, zeros)
        energy = jnp.maximum(square - total**2 / n**2, 0) * jnp.sum(mine**2, axis=0)[None, None]
        scores = jnp.where(share > _INSIDE * n**2, product / jnp.sqrt(energy + _NOISE * n**2), _OUTSIDE)
        move, score, curvature = _peak(scores, window.reach, strict)
        score = jnp.where(own_share > _INSIDE, score, 0)
        return expected + jnp.einsum("pab,pb->pa", warp, move) / side, score, curvature

    return jax.lax.map(of_pair, (own, other, expected, warp))


def _peak(
    scores: Float[Array, "N N P"], reach: int, strict: bool
) -> tuple[Float[Array, "P 2"], Float[Array, " P"], Float[Array, " P"]]:
    """Return the shift x, y of the best score by a parabola through the nine around it, the score and its curvature."""
    last, at = 2 * reach, jnp.arange(scores.shape[2])
    best = jnp.argmax(scores.reshape(-1, len(at)), axis=0)
    row, column = best // (last + 1), best % (last + 1)
    at_rim = (row == 0) | (row == last) | (column == 0) | (column == last)
    row, column = jnp.clip(row, 1, last - 1), jnp.clip(column, 1, last - 1)
    if strict:  # a parabola through a shift that leaves the picture is moved
        around = [scores[row + down, column + right, at] for down in (-1, 0, 1) for right in (-1, 0, 1)]
        at_rim |= jnp.min(jnp.stack(around), axis=0) <= _OUTSIDE

    def near(down: int, right: int) -> Array:
        return scores[row + down, column + right, at]

    score = near(0, 0)
    slope = jnp.stack([near(0, 1) - near(0, -1), near(1, 0) - near(-1, 0)], axis=-1) / 2
    xx, yy = near(0, 1) - 2 * score + near(0, -1), near(1, 0) - 2 * score + near(-1, 0)
    xy = (near(1, 1) - near(1, -1) - near(-1, 1) + near(-1, -1)) / 4
    determinant = xx * yy - xy**2
    is_peak = (determinant > 1e-8) & (xx < 0)
    newton = -jnp.stack([yy * slope[:, 0] - xy * slope[:, 1], xx * slope[:, 1] - xy * slope[:, 0]], axis=-1)
    newton = jnp.where(is_peak[:, None], newton / jnp.where(is_peak, determinant, 1)[:, None], 0)
    flattest = -(xx + yy) / 2 - jnp.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    move = jnp.stack([column, row], axis=-1) - reach + jnp.clip(newton, -_MOST_MOVE, _MOST_MOVE)
    return move, jnp.where(at_rim, 0, score), jnp.where(is_peak, flattest, 0)


def _is_in(places: Float[Array, "*N 2"], box: Float[Array, " 4"]) -> Bool[Array, "*N"]:
    """Return whether places x, y lie in a box of left, top, right and bottom."""
    low, high = (corner.reshape((1,) * (places.ndim - 1) + (2,)) for corner in (box[:2], box[2:]))
    return jnp.all((places >= low) & (places <= high), axis=-1)


def _offsets(reach: int) -> Float32[np.ndarray, "K 2"]:
    """Return x, y of the places of a square window, row by row."""
    steps = np.arange(-reach, reach + 1, dtype=np.float32)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _sample(picture: Float[Array, "H W"], places: Float[Array, "*N 2"]) -> Float[Array, "*N"]:
    """Return values at x, y in pixels, bilinear between pixel centres; the rim goes on outside."""
    H, W = picture.shape
    x, y = jnp.clip(places[..., 0] - 0.5, 0, W - 1.001), jnp.clip(places[..., 1] - 0.5, 0, H - 1.001)
    column, row = jnp.floor(x).astype(int), jnp.floor(y).astype(int)
    right, down = x - column.astype(x.dtype), y - row.astype(y.dtype)
    flat, corner = picture.reshape(-1), row * W + column
    above = flat[corner] * (1 - right) + flat[corner + 1] * right
    below = flat[corner + W] * (1 - right) + flat[corner + W + 1] * right
    return above * (1 - down) + below * down


def expected_matches(
    depth: Float[np.ndarray, "S P"], cameras: Cameras, grid: tuple[int, int]
) -> tuple[Float32[np.ndarray, "S M P 2"], Float32[np.ndarray, "S M P 2 2"]]:
    """Return where each patch, a plane across its ray at this depth, is seen in the other frames, and the derivative.

    `cameras` have intrinsics in patches. Positions are in patches.
    """
    pairs, K, poses = frame_pairs(len(depth)), cameras.intrinsics, cameras.camera_from_world
    turn = np.einsum("smij,skj->smik", poses[pairs.others][..., :3], poses[..., :3])
    shift = poses[pairs.others][..., 3] - np.einsum("smij,sj->smi", turn, poses[..., 3])
    focal, centre = K[:, [0, 1], [0, 1]][:, None], K[:, :2, 2][:, None]
    nearest = _NEAREST * np.median(depth)

    def seen(offset: tuple[float, float]) -> Float[np.ndarray, "S M P 2"]:
        rays = (patch_centres(grid)[None] + offset - centre) / focal
        points = depth[..., None] * np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
        points = np.einsum("smij,spj->smpi", turn, points) + shift[:, :, None]
        flat = points[..., :2] / np.maximum(points[..., 2:], nearest)
        return flat * focal[pairs.others] + centre[pairs.others]

    step = 0.25
    warp = np.stack([seen((step, 0)) - seen((-step, 0)), seen((0, step)) - seen((0, -step))], axis=-1) / (2 * step)
    return seen((0, 0)).astype(np.float32), np.clip(warp, -_MOST_STRETCH, _MOST_STRETCH).astype(np.float32)


def cycles(
    position: Float32[np.ndarray, "S M P 2"], pairs: FramePairs, grid: tuple[int, int]
) -> Float32[np.ndarray, "S M P"]:
    """Return how far from each patch, in patches, the match of its match is, read between four patches."""
    h, w = grid
    result = np.full(position.shape[:3], _LOST, np.float32)
    back = [pairs.offsets.index(-offset) for offset in pairs.offsets]
    for s, m in zip(*np.nonzero(pairs.exist), strict=True):
        place = position[s, m] - 0.5
        near = np.clip(place, 0, [w - 1.001, h - 1.001])
        column, row = near.astype(int).T
        right, down = (near - np.stack([column, row], axis=-1)).T[..., None]
        of_other = position[pairs.others[s, m], back[m]].reshape(h, w, 2)
        above = of_other[row, column] * (1 - right) + of_other[row, column + 1] * right
        below = of_other[row + 1, column] * (1 - right) + of_other[row + 1, column + 1] * right
        returned = above * (1 - down) + below * down + place - near
        inside = ((place > -0.5) & (place < np.array([w, h]) - 0.5)).all(axis=-1)
        result[s, m] = np.where(inside, np.linalg.norm(returned - patch_centres(grid), axis=-1), _LOST)
    return result
