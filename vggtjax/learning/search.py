"""Hundreds of trees at once, and how sure a fitted one is: searches, curvature, standard errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vggtjax.errors import InputError
from vggtjax.learning.fit import FitClips, Objective, clip_losses
from vggtjax.method.fusion_rule import PARTS, FusionParams, identity, projected

AT_ONCE = 16  # candidates that are vectorised together; the others wait


def random_candidates(key: Array, count: int, family: Sequence[str], spread: float = 1.0) -> FusionParams:
    """Return `count` trees, stacked: the free leaves normal around the paper's rule, projected into their ranges."""
    _check_parts(family)
    trees = {name: jnp.broadcast_to(leaf, (count, *leaf.shape)) for name, leaf in identity().items()}
    for name, drawn in zip(family, jax.random.split(key, len(family)), strict=True):
        trees[name] = trees[name] + spread * jax.random.normal(drawn, trees[name].shape)
    return projected(trees)


def grid_candidates(values: Mapping[str, Sequence[float]]) -> FusionParams:
    """Return the trees of all combinations of values, stacked in the order of `itertools.product`.

    A part with a value for each pass is named "power1" or "power2" for one of them, "power" for both alike.
    """
    combinations = np.asarray(list(product(*values.values())), np.float32).reshape(-1, len(values))
    trees = {name: jnp.broadcast_to(leaf, (len(combinations), *leaf.shape)) for name, leaf in identity().items()}
    for column, name in zip(combinations.T, values, strict=True):
        one = name[:-1] in PARTS and name[-1] in "12" and bool(PARTS[name[:-1]].shape)
        part, which = (name[:-1], int(name[-1]) - 1) if one else (name, None)
        _check_parts([part])
        if which is not None:
            trees[part] = trees[part].at[:, which].set(jnp.asarray(column))
        else:
            shape = (-1,) + (1,) * len(PARTS[part].shape)
            trees[part] = jnp.broadcast_to(jnp.asarray(column).reshape(shape), trees[part].shape)
    return projected(trees)


@partial(jax.jit, static_argnames=("objective",))
def candidate_losses(candidates: FusionParams, clips: FitClips, objective: Objective) -> Float[Array, "K C"]:
    """Return the objective of every clip under each of K stacked trees, in one compiled call."""
    return jax.lax.map(lambda params: clip_losses(params, clips, objective), candidates, batch_size=AT_ONCE)


def take_candidate(candidates: FusionParams, index: int) -> FusionParams:
    """Return one of stacked trees."""
    return jax.tree.map(lambda leaf: leaf[index], candidates)


def free_vector(
    params: FusionParams, family: Sequence[str]
) -> tuple[Float[Array, " n"], Callable[[Array], FusionParams]]:
    """Return the free leaves as one vector, and the function from such a vector to the tree."""
    vector, unravel = ravel_pytree({name: params[name] for name in params if name in family})
    return vector, lambda vector: params | unravel(vector)


def hessian_vector_product(
    loss: Callable[[FusionParams], Array], params: FusionParams, family: Sequence[str], vector: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Return the Hessian of `loss` by the free leaves times a vector, at the cost of two gradients."""
    at, tree = free_vector(params, family)
    return jax.jvp(jax.grad(lambda x: loss(tree(x))), (at,), (vector,))[1]


def jacobian(
    function: Callable[[FusionParams], Array], params: FusionParams, family: Sequence[str]
) -> Float[Array, "... n"]:
    """Return the derivative of what a function makes of a tree, such as fused depth, by the free leaves."""
    at, tree = free_vector(params, family)
    return jax.jacfwd(lambda x: function(tree(x)))(at)


def standard_errors(
    params: FusionParams, clips: FitClips, family: Sequence[str], objective: Objective = "gaussian"
) -> FusionParams:
    """Return the standard error of every free leaf of a fitted tree; 0 for the others.

    H^-1 (sum over clips of g g^T) H^-1, with a clip's gradient g and the Hessian H of the sum over clips: clips are
    independent observations, pixels of one clip need not be, and the objective need not be the true likelihood (the
    sandwich estimator, clustered by clip). It takes more clips than free numbers, and is too small with few.

    Raises InputError for too few clips, for a part at the end of its range, or where the objective has no minimum at
    the tree: a direction along which it does not rise.
    """
    for name in family:
        part = PARTS.get(name)
        if part is not None and (np.isin(np.asarray(params[name]), [part.low, part.high])).any():
            raise InputError(f"{name} is {np.asarray(params[name]).tolist()}, at the end of its range; leave it out")
    at, tree = free_vector(params, family)
    if clips.clips <= len(at):
        raise InputError(
            f"{clips.clips} clips for {len(at)} free numbers; standard errors need more clips than numbers"
        )

    def losses(x: Array) -> Array:
        return clip_losses(tree(x), clips, objective)

    gradients = np.asarray(jax.jit(jax.jacrev(losses))(at), np.float64)
    hessian = np.asarray(jax.jit(jax.hessian(lambda x: losses(x).sum()))(at), np.float64)
    values = np.linalg.eigvalsh(hessian)
    if not np.isfinite(values).all() or values[0] <= 1e-7 * values[-1]:
        raise InputError(
            "the objective is flat in some direction of the free parts; free fewer of them, or fit further"
        )
    gradients = gradients - gradients.mean(axis=0)
    scores = gradients.T @ gradients * clips.clips / (clips.clips - 1)
    inverse = np.linalg.inv(hessian)
    errors = np.sqrt(np.diag(inverse @ scores @ inverse))
    spread = tree(jnp.asarray(errors, at.dtype))
    return {
        name: leaf if name in family else jax.tree.map(jnp.zeros_like, params[name]) for name, leaf in spread.items()
    }


def _check_parts(names: Sequence[str]) -> None:
    if unknown := [name for name in names if name not in PARTS]:
        raise InputError(f"{unknown[0]!r} is no part of a tree; expected some of {', '.join(PARTS)}")
