"""k-means on the device with weighted points: greedy k-means++ seeds, then Lloyd's iterations.

The seeding draws several candidates for every centre and keeps the best one, as scikit-learn does (Arthur and
Vassilvitskii, 2007; the greedy variant of their conclusion).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vggtjax.network.precision import full_precision

ITERATIONS = 300
TOLERANCE = 1e-4  # the iterations end at this squared movement of all centres over the mean variance of the points


class Clusters(NamedTuple):
    """A partition of points by their nearest centres."""

    labels: Int[Array, " N"]
    centres: Float[Array, "K C"]
    inertia: Float[Array, ""]  # sum of weighted squared distances to the nearest centre


@full_precision()
def kmeans(
    key: Array,
    points: Float[Array, "N C"],
    clusters: int,
    weights: Float[Array, " N"] | None = None,
    *,
    restarts: int = 1,
) -> Clusters:
    """Partition points into `clusters` groups of small squared distance to their means.

    Pure: works under jit and vmap (`clusters` and `restarts` are static). An empty cluster keeps its centre.

    Args:
        key: JAX random key for the seeds.
        points: any number of points, also fewer than `clusters`.
        clusters: number of centres.
        weights: at least 0; points of weight 0 are labelled but move no centre. 1 if None.
        restarts: number of partitions from different seeds; the one of least inertia is returned.
    """
    weights = jnp.ones(points.shape[0]) if weights is None else weights.astype(jnp.float32)
    total = jnp.maximum(weights.sum(), 1e-30)
    mean = jnp.einsum("n,nc->c", weights, points) / total
    points = points - mean[None]  # squares of points far from the origin would cancel
    variance = jnp.einsum("n,nc->c", weights, points**2).mean() / total
    keys = jax.random.split(key, restarts)
    partitions = jax.lax.map(
        lambda key: _lloyd(_seeds(key, points, clusters, weights), points, weights, variance), keys
    )
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(partitions.inertia)], partitions)
    return best._replace(centres=best.centres + mean[None])


def _lloyd(centres: Array, points: Array, weights: Array, variance: Array) -> Clusters:
    clusters = len(centres)

    def not_converged(state):
        _, shift, count = state
        return (shift > TOLERANCE * variance) & (count < ITERATIONS)

    def iteration(state):
        centres, _, count = state
        labels = jnp.argmin(_distances(points, centres), axis=1)
        member = jax.nn.one_hot(labels, clusters) * weights[:, None]
        mass = member.sum(axis=0)[:, None]
        means = jnp.einsum("nk,nc->kc", member, points) / jnp.maximum(mass, 1e-30)
        means = jnp.where(mass > 0, means, centres)
        return means, jnp.sum((means - centres) ** 2), count + 1

    centres, _, _ = jax.lax.while_loop(not_converged, iteration, (centres, jnp.inf, 0))
    distances = _distances(points, centres)
    inertia = (weights * jnp.maximum(distances.min(axis=1), 0)).sum()
    return Clusters(jnp.argmin(distances, axis=1).astype(jnp.int32), centres, inertia)


def _seeds(key: Array, points: Float[Array, "N C"], clusters: int, weights: Float[Array, " N"]) -> Float[Array, "K C"]:
    """Draw centres among the points by their squared distance to earlier centres, each the best of a few candidates."""
    trials = 2 + int(math.log(clusters))
    keys = jax.random.split(key, clusters)

    def draw(key: Array, mass: Float[Array, " N"], count: int) -> Float[Array, "T C"]:
        cumulative = jnp.cumsum(mass)
        index = jnp.searchsorted(cumulative, jax.random.uniform(key, (count,)) * cumulative[-1])
        return points[jnp.minimum(index, len(cumulative) - 1)]

    first = draw(keys[0], weights, 1)[0]
    centres = jnp.zeros((clusters, points.shape[1])).at[:].set(first[None])

    def add(i, state):
        centres, nearest = state
        candidates = draw(keys[i], weights * nearest, trials)
        distances = jnp.minimum(nearest[:, None], jnp.maximum(_distances(points, candidates), 0))  # [N, T]
        best = jnp.argmin(jnp.einsum("n,nt->t", weights, distances))
        return centres.at[i].set(candidates[best]), distances[:, best]

    nearest = jnp.maximum(_distances(points, first[None])[:, 0], 0)
    centres, _ = jax.lax.fori_loop(1, clusters, add, (centres, nearest))
    return centres


def nearest_centre(points: Float[Array, "N C"], centres: Float[Array, "K C"]) -> Int[Array, " N"]:
    """Return the index of the nearest centre of each point."""
    middle = centres.mean(axis=0)[None]  # squares of points far from the origin would cancel
    return jnp.argmin(_distances(points - middle, centres - middle), axis=1).astype(jnp.int32)


def _distances(points: Float[Array, "N C"], centres: Float[Array, "K C"]) -> Float[Array, "N K"]:
    """Return squared distances; rounding can take them slightly below 0."""
    squares = jnp.sum(points**2, axis=1)[:, None] + jnp.sum(centres**2, axis=1)[None]
    return squares - 2 * points @ centres.T
