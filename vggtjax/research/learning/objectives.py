"""Objectives of fits: likelihoods of true depth, and the agreement of frames where the truth is unknown.

Each is of one clip, [S, H, W]. Of a batch [B, S, H, W] every clip has a unit of its own, and the objective is the mean
over clips.
"""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.cameras import Cameras, unproject
from vggtjax.method.fusion.family import Fused, FusionParams, Observations, fuse, log_precisions
from vggtjax.network.heads.sampling import bilinear
from vggtjax.network.precision import full_precision

Likelihood = Literal["gaussian", "laplace"]
_MOST = 80.0
_FURTHEST = 1e12  # standard deviations
_NEAREST = 1e-6  # least depth for a logarithm
_TINY = 1e-12
_LOG_2PI = 1.8378770664093453
_LOG_2 = 0.6931471805599453


class View(NamedTuple):
    """Frames of one scene: pictures and cameras, of the shape of a fused depth."""

    images: Float[Array, "S H W 3"]
    cameras: Cameras  # [S, 3, 4] and [S, 3, 3]


def negative_log_likelihood(
    fused: Fused, truth: Float[Array, "*F H W"], kind: Likelihood = "gaussian"
) -> Float[Array, ""]:
    """Return the mean negative log likelihood of a clip's true depth, in nats per pixel.

    The truth is scaled to the prediction's unit by the factor of greatest likelihood: a weighted mean of squares for
    "gaussian", a weighted median for "laplace". No gradient passes through the median, whose own gradient is 0.

    Args:
        fused: depth and its precision, of one clip.
        truth: depth; at most 0, or not finite, where it is unknown.
        kind: "gaussian", or "laplace" with the same variance.
    """
    if fused.depth.ndim > 3:
        return jnp.mean(jax.vmap(partial(negative_log_likelihood, kind=kind))(fused, truth))
    known = (truth > 0) & jnp.isfinite(truth)
    truth = jnp.where(known, truth, 1)
    factor = unit_factor(fused, truth, known, kind)
    error = jnp.where(known, fused.depth - factor * truth, 0)
    log_precision = jnp.where(known, fused.log_precision, 0)
    if kind == "gaussian":
        square = jnp.exp(jnp.minimum(jnp.log(error * error + _TINY**2) + log_precision, _MOST))
        loss = (_LOG_2PI - log_precision + square) / 2
    else:
        loss = _laplace(error, -log_precision)
    return jnp.sum(jnp.where(known, loss, 0)) / jnp.maximum(known.sum(), 1).astype(fused.depth.dtype)


def joint_negative_log_likelihood(
    params: FusionParams, seen: Observations, truth: Float[Array, "*F H W"]
) -> Float[Array, ""]:
    """Return the mean negative log likelihood of both passes' errors, jointly normal, in nats per pixel.

    This objective measures the correlation of the errors; the likelihood of the fused depth depends on the correlation
    through the fused precision alone. On dynamic pixels only pass 1 counts. Soft masks and robust parts (inflation,
    distrust) do not enter. Arguments as for `fuse`, alignment as for `negative_log_likelihood`.
    """
    if seen.depth1.ndim > 3:
        return jnp.mean(jax.vmap(partial(joint_negative_log_likelihood, params))(seen, truth))
    known = (truth > 0) & jnp.isfinite(truth)
    truth = jnp.where(known, truth, 1)
    fused = fuse(params, seen)
    factor = unit_factor(fused, truth, known)
    claims, rho = log_precisions(params, seen), params["correlation"]
    first, second = (
        jnp.where(known, depth - factor * truth, 0) * jnp.exp(jnp.clip(claim, -_MOST, _MOST) / 2)
        for depth, claim in zip((seen.depth1, seen.depth2), claims, strict=True)
    )
    first, second = (jnp.clip(x, -_FURTHEST, _FURTHEST) for x in (first, second))
    left = 1 - rho * rho
    alone = (_LOG_2PI - claims[0] + first * first) / 2
    residual = second - rho * first  # of pass 2 conditional on pass 1, with variance 1 - rho^2
    other = (_LOG_2PI - claims[1] + jnp.log(left) + residual * residual / left) / 2
    loss = alone + (1 - seen.dynamic) * other
    return jnp.sum(jnp.where(known, loss, 0)) / jnp.maximum(known.sum(), 1).astype(fused.depth.dtype)


def _laplace(error: Float[Array, "*S"], log_variance: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Return the negative log likelihood of errors by a Laplace distribution of a variance, in nats."""
    log_width = (log_variance - _LOG_2) / 2
    return _LOG_2 + log_width + jnp.exp(jnp.minimum(jnp.log(jnp.abs(error) + _TINY) - log_width, _MOST))


def unit_factor(
    fused: Fused, truth: Float[Array, "*F H W"], known: Bool[Array, "*F H W"], kind: Likelihood = "gaussian"
) -> Float[Array, ""]:
    """Return the factor of greatest likelihood from true depth to the unit of a prediction."""
    top = jax.lax.stop_gradient(jnp.where(known, fused.log_precision, -jnp.inf).max())
    top = jnp.where(jnp.isfinite(top), top, 0)  # of a clip without truth
    weight = jnp.where(known, jnp.exp(jnp.where(known, fused.log_precision, top) - top), 0)  # the largest is 1
    if kind == "gaussian":
        return jnp.sum(weight * fused.depth * truth) / jnp.maximum(jnp.sum(weight * truth * truth), _TINY)
    ratio, weight = jax.lax.stop_gradient(((fused.depth / truth).ravel(), (jnp.sqrt(weight) * truth).ravel()))
    order = jnp.argsort(ratio)
    below = jnp.cumsum(weight[order])
    return ratio[order][jnp.searchsorted(below, below[-1] / 2)]


@full_precision()
def photometric_loss(fused: Fused, view: View, step: int = 1) -> Float[Array, ""]:
    """Return the difference of pictures after reprojection by the fused depth.

    Mean absolute difference of the colours (in [0, 1]) between frames `step` apart, in both directions, over static
    pixels that both frames see.
    """

    if fused.depth.ndim > 3:
        return jnp.mean(jax.vmap(partial(photometric_loss, step=step))(fused, view))

    def pair(depth, static, image, other, here, there):
        position, z = _reproject(depth, here, there)
        colour, inside = _sample(other, position)
        weight = static * inside * (z > 0)
        difference = jnp.abs(image - colour).mean(axis=-1)
        return jnp.sum(weight * difference), jnp.sum(weight)

    return _over_pairs(pair, fused, view, step)


@full_precision()
def geometric_loss(fused: Fused, view: View, step: int = 1) -> Float[Array, ""]:
    """Return the negative log likelihood of the depths of frames given each other, for fits without any truth.

    The logarithm of the depth of a frame's pixels in the camera of another frame, minus that of the other frame's depth
    there, has the relative variance of both depths. The mean of its negative log likelihood (Laplace) is over static
    pixels that both frames see and that are not far behind the depth of the other frame. The unit of depth has no
    effect, nor have errors that all frames share.
    """

    if fused.depth.ndim > 3:
        return jnp.mean(jax.vmap(partial(geometric_loss, step=step))(fused, view))

    def pair(depth, static, image, other, here, there):
        del image
        position, z = _reproject(depth[..., 0], here, there)
        sampled, inside = _sample(other, position)
        valid = inside & (z > _NEAREST) & (sampled[..., 0] > _NEAREST) & (z < 1.2 * sampled[..., 0])
        weight = static * valid
        logs = [jnp.log(jnp.where(valid, value, 1)) for value in (z, sampled[..., 0])]
        log_variance = jnp.logaddexp(-depth[..., 1] - 2 * logs[0], -sampled[..., 1] - 2 * logs[1])
        loss = _laplace(logs[0] - logs[1], log_variance)
        return jnp.sum(jnp.where(valid, weight * loss, 0)), jnp.sum(weight)

    maps = jnp.stack([fused.depth, fused.log_precision], axis=-1)
    return _over_pairs(pair, fused, View(maps, view.cameras), step, maps)


def _over_pairs(pair, fused: Fused, view: View, step: int, depth: Array | None = None) -> Float[Array, ""]:
    """Return the weighted mean over pairs of frames `step` apart, in both directions."""
    depth = fused.depth if depth is None else depth
    static = 1 - jax.lax.stop_gradient(fused.dynamic)
    total = weight = jnp.zeros((), fused.depth.dtype)
    earlier, later = slice(0, len(depth) - step), slice(step, len(depth))
    for here, there in ((earlier, later), (later, earlier)):
        cameras = [Cameras(*(x[part] for x in view.cameras)) for part in (here, there)]
        sums = jax.vmap(pair)(depth[here], static[here], view.images[here], view.images[there], *cameras)
        total, weight = total + sums[0].sum(), weight + sums[1].sum()
    return total / jnp.maximum(weight, 1)


def _reproject(
    depth: Float[Array, "H W"], here: Cameras, there: Cameras
) -> tuple[Float[Array, "H W 2"], Float[Array, "H W"]]:
    """Return the positions (x, y in pixels) and depths of a frame's pixels in another camera."""
    points = unproject(depth, here.intrinsics, here.camera_from_world, pixel_offset=0.5)
    pose, K = there
    moved = points @ pose[:, :3].T + pose[:, 3][None, None]
    z = moved[..., 2]
    safe = jnp.where(z > 1e-6, z, 1)
    return jnp.stack([moved[..., 0] / safe * K[0, 0] + K[0, 2], moved[..., 1] / safe * K[1, 1] + K[1, 2]], axis=-1), z


def _sample(
    maps: Float[Array, "H W C"], position: Float[Array, "H W 2"]
) -> tuple[Float[Array, "H W C"], Bool[Array, "H W"]]:
    """Return maps at positions, and which positions lie between pixel centres; differentiable by both arguments."""
    H, W = maps.shape[:2]
    position = jnp.where(jnp.isfinite(position), position, -1) - 0.5
    x, y = position[..., 0], position[..., 1]
    inside = (x >= 0) & (x <= W - 1) & (y >= 0) & (y <= H - 1)
    return bilinear(maps, jnp.where(inside[..., None], position, 0)), inside
