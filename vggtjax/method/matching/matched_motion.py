"""The score of motion by matches that do not fit a static world, with the Gram saliency: "4dvggt-m", not in the papers.

The papers' motion cues are `config.MotionConfig` and `method.cues`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.cameras import Cameras
from vggtjax.method.matching.adjustment import Static, adjust
from vggtjax.method.matching.matches import FramePairs, Matches, come_back, frame_pairs
from vggtjax.network.precision import full_precision

FEWEST_FRAMES = 3  # two views of a point that moves along its ray or against the camera fit a static world
_SMALLEST_SCALE = 0.1875  # patches; a soft-argmax is no more precise, so smaller differences are no motion
_LARGEST = 8.0  # differences beyond this many scales count as this
_OUTSIDE = 0.2  # weight of matches whose static position is outside the other frame
_MARGIN = 0.25  # patches by which it may be outside
_OFFSET, _EXPONENT, _FLOOR = 0.25, 0.6, 0.1  # score = log(difference + offset) + exponent x log(Gram + floor)
_ROUNDS = 2  # what moves by the first counts less in the second
_STILL, _STEEPNESS = float(np.log(0.8)), 4.0  # of the weights in the second round
VOTE = 0.3  # of a sure match
_VOTES, _VOTE_CYCLE, _VOTE_FRAMES = 2, 0.625, 6.0


class Motion(NamedTuple):
    """What a clip's matches say of motion."""

    score: Float[Array, "*B S P"]  # positive, and larger for patches that move; the clip's median is its scale
    is_matched: Bool[Array, "*B"]  # whether enough matches come back; else the score says nothing
    world: Static  # the static world that fits best


@full_precision()
def motion(
    matches: Matches,
    saliency: Float[Array, "S P"],
    depth: Float[Array, "S P"],
    cameras: Cameras,
    grid: tuple[int, int],
) -> Motion:
    """Return how far every patch of a clip differs from a static world. Pure and differentiable.

    Cameras and depths are adjusted to the matches first, so that their errors are not taken for motion.

    Args:
        matches: of the clip's S frames.
        saliency: the Gram saliency of every patch, in [0, 1].
        depth: of the centre of every patch, by the first pass.
        cameras: of the first pass; intrinsics in patches.
        grid: rows and columns of patches.
    """
    pairs = frame_pairs(len(depth))
    weight = matches.weight

    def fitted(trust: Float[Array, "S P"], _: None) -> tuple[Float[Array, "S P"], tuple[Static, Float[Array, "S P"]]]:
        world = adjust(depth, cameras, matches.position, weight * trust[:, None], grid)
        difference = _difference(matches.position, weight, world, pairs, grid)
        score = jnp.log(difference + _OFFSET) + _EXPONENT * jnp.log(saliency + _FLOOR)
        votes = VOTE * matches.confidence * jnp.exp(-((matches.cycle / _VOTE_CYCLE) ** 2))
        score = voted(score, matches.position, votes, pairs, grid)
        return jax.nn.sigmoid(_STEEPNESS * (_STILL - score)), (world, score)

    _, rounds = jax.lax.scan(fitted, 1.05 - saliency, length=_ROUNDS)  # a loop: it is compiled once
    world, score = jax.tree.map(lambda x: x[-1], rounds)
    return Motion(jnp.exp(score), come_back(matches, pairs) & jnp.isfinite(score).all(), world)


def _difference(
    matched: Float[Array, "S M P 2"],
    weight: Float[Array, "S M P"],
    world: Static,
    pairs: FramePairs,
    grid: tuple[int, int],
) -> Float[Array, "S P"]:
    """Return the mean distance between matches and static positions, over the clip's median."""
    distance = jnp.sqrt(jnp.sum((world.position - matched) ** 2, axis=-1) + 1e-12)
    scale = jnp.maximum(jnp.median(distance[np.nonzero(pairs.exist)]), _SMALLEST_SCALE)
    size = np.array(grid[::-1], np.float32)
    from_middle = jnp.abs(world.position - size[None, None, None] / 2)
    inside = (from_middle < size[None, None, None] / 2 + _MARGIN).all(axis=-1) & (world.in_front > 0)
    weight = weight * jnp.where(inside, 1, _OUTSIDE)
    total = jnp.sum(weight * jnp.minimum(distance / scale, _LARGEST), axis=1)
    return total / jnp.maximum(weight.sum(axis=1), 1e-6)


def voted(
    score: Float[Array, "S P"],
    position: Float[Array, "S M P 2"],
    votes: Float[Array, "S M P"],
    pairs: FramePairs,
    grid: tuple[int, int],
) -> Float[Array, "S P"]:
    """Return scores averaged along matches at positions in patches: the same surface moves in the other frames too."""
    place = jnp.floor(position).astype(int)
    column, row = (jnp.clip(place[..., i], 0, grid[1 - i] - 1) for i in range(2))
    near_in_time = np.exp(-((np.array(pairs.offsets) / _VOTE_FRAMES) ** 2)).astype(np.float32)[None, :, None]
    votes = votes * near_in_time
    for _ in range(_VOTES):
        theirs = jnp.take_along_axis(score[pairs.others], row * grid[1] + column, axis=2)
        score = (score + jnp.sum(votes * theirs, axis=1)) / (1 + votes.sum(axis=1))
    return score
