"""Standard errors of a fitted tree, clustered by clip (the sandwich estimator)."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vggtjax.errors import InputError
from vggtjax.learning.fit import FitClips, Objective, clip_loss
from vggtjax.method.fusion_family import PARTS, FusionParams


def clip_losses(params: FusionParams, clips: FitClips, objective: Objective) -> Float[Array, " C"]:
    """Return the objective of every clip."""
    return jax.vmap(clip_loss, in_axes=(None, 0, None))(params, clips, objective)


def standard_errors(
    params: FusionParams, clips: FitClips, family: Sequence[str], objective: Objective = "gaussian"
) -> FusionParams:
    """Return the standard error of every free leaf of a fitted tree; 0 for the other leaves.

    H^-1 (sum over clips of g g^T) H^-1, with a clip's gradient g and the Hessian H of the sum over clips. Clips are
    independent observations; pixels of one clip may depend on each other, and the objective may differ from the true
    likelihood. Errors of few clips are too small.

    Raises InputError unless there are more clips than free numbers, for a part at the end of its range, and where the
    objective has no minimum at the tree.
    """
    for name in family:
        part = PARTS.get(name)
        if part is not None and (np.isin(np.asarray(params[name]), [part.low, part.high])).any():
            raise InputError(f"{name} is {np.asarray(params[name]).tolist()}, at the end of its range; leave it out")
    vector, unravel = ravel_pytree({name: params[name] for name in params if name in family})
    if clips.clips <= len(vector):
        raise InputError(
            f"{clips.clips} clips for {len(vector)} free numbers; standard errors need more clips than numbers"
        )

    def losses(x: Array) -> Array:
        return clip_losses(params | unravel(x), clips, objective)

    gradients = np.asarray(jax.jit(jax.jacrev(losses))(vector), np.float64)
    hessian = np.asarray(jax.jit(jax.hessian(lambda x: losses(x).sum()))(vector), np.float64)
    values = np.linalg.eigvalsh(hessian)
    if not np.isfinite(values).all() or values[0] <= 1e-7 * values[-1]:
        raise InputError(
            "the objective is flat in some direction of the free parts; free fewer of them, or fit further"
        )
    gradients = gradients - gradients.mean(axis=0)
    scores = gradients.T @ gradients * clips.clips / (clips.clips - 1)
    inverse = np.linalg.inv(hessian)
    errors = np.sqrt(np.diag(inverse @ scores @ inverse))
    return jax.tree.map(jnp.zeros_like, params) | unravel(jnp.asarray(errors, vector.dtype))
