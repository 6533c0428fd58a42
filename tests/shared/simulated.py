"""Observations of two passes whose variances and correlation are known: what a fit must find again."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.method.fusion.family import FEATURES, FusionParams, Observations, log_precisions, projected

DEEPEST, NEAREST = 3.0, 1.0


def scattered(params: FusionParams, seed: int = 0) -> FusionParams:
    """Return a tree with normal noise of 0.1 on every leaf, within the ranges."""
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    noisy = [leaf + 0.1 * jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
    return projected(jax.tree.unflatten(structure, noisy))


@partial(jax.jit, static_argnames=("shape",))
def simulate(
    key: Array, truth: FusionParams, shape: tuple[int, ...], *, noise: float = 1.0
) -> tuple[Observations, Float[Array, "*F H W"]]:
    """Draw depth, confidences and errors as a tree of the family claims them to be; return observations and true depth.

    True depth is uniform in [1, 3], log confidence normal and correlated between the passes, features uniform in
    [0, 1], nothing moves. The errors are normal with variance noise^2 / precision and the tree's correlation.

    Args:
        key: of the random numbers.
        truth: a tree of the family; offset and temperature, inflation and distrust have no part in it.
        shape: of the maps, (frames, height, width) or with more axes in front.
        noise: factor on the standard deviations; 0 for no errors.
    """
    keys = jax.random.split(key, 5)
    depth = jax.random.uniform(keys[0], shape, minval=NEAREST, maxval=DEEPEST)
    common, own = jax.random.normal(keys[1], shape), jax.random.normal(keys[2], (2, *shape))
    confidence = [1 + 0.6 * common + 0.8 * one for one in own]
    features = jax.random.uniform(keys[3], (*shape, len(FEATURES)))
    zero = jnp.zeros(shape)
    seen = Observations(depth, confidence[0], depth, confidence[1], zero, zero - 1, features)
    first, second = log_precisions(truth, seen)
    draws, rho = jax.random.normal(keys[4], (2, *shape)), truth["correlation"]
    errors = (draws[0], rho * draws[0] + jnp.sqrt(1 - rho * rho) * draws[1])
    depths = [depth + noise * error * jnp.exp(-claim / 2) for error, claim in zip(errors, (first, second), strict=True)]
    return seen._replace(depth1=depths[0], depth2=depths[1]), depth
