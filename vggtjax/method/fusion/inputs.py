"""Two passes over a clip -> the inputs of a fusion rule, `Observations` (declared in `method.fusion.family`)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtjax.errors import InputError
from vggtjax.method.fusion.family import Observations
from vggtjax.method.fusion.rule import clip_median
from vggtjax.method.mask import upsample
from vggtjax.method.passes import Passes

REACH = 64  # pixels; larger distances to the mask's edge are infinite
_SMALLEST = 1e-6
_STILL = -1e3  # margin of pixels that are static at any temperature


def observe(passes: Passes, *, scale: Float[Array, " B"] | None = None) -> Observations:
    """Return the inputs of `fuse` for two passes.

    The features are the saliency; log depth of pass 1 over the clip's median; exp(-d / patch size) with the distance
    d to the mask's edge, 0 beyond `REACH` pixels; and the mask. No gradient passes through the distance.

    Args:
        passes: both, with depth; the mask is boolean or of shares in [0, 1].
        scale: factor on the depth of the second pass, as from `scale_between`; 1 if None.

    Raises InputError where a pass, its depth or its confidence is missing.
    """
    first, second = passes.first, passes.second
    if second is None or first.depth is None or second.depth is None:
        raise InputError("fusion needs depth and confidence of both passes; run them with both outputs")
    if first.depth_confidence is None or second.depth_confidence is None:
        raise InputError("fusion needs the confidence of both passes, and one pass lacks it")
    depth1, depth2 = first.depth, second.depth
    depth2 = depth2 if scale is None else depth2 * scale[:, None, None, None]
    dynamic = passes.dynamic_mask.astype(depth1.dtype)
    saliency = upsample(passes.saliency, (depth1.shape[2], depth1.shape[3]))
    hard = jax.lax.stop_gradient(dynamic) >= 0.5
    median = clip_median(depth1)[:, None, None, None]
    log_depth = jnp.log(jnp.maximum(depth1, _SMALLEST)) - jnp.log(jnp.maximum(median, _SMALLEST))
    patch_size = depth1.shape[2] // passes.saliency.shape[2]
    features = [saliency, log_depth, jax.vmap(jax.vmap(lambda frame: edge_proximity(frame, patch_size)))(hard), dynamic]
    return Observations(
        depth1,
        _log_confidence(first.depth_confidence),
        depth2,
        _log_confidence(second.depth_confidence),
        dynamic,
        jax.vmap(_margin)(saliency, hard),
        jnp.stack(features, axis=-1),
    )


def edge_proximity(mask: Bool[Array, "H W"], patch_size: int) -> Float[Array, "H W"]:
    """Return exp(-d / patch_size) with d from `edge_distance`."""
    return jnp.exp(-edge_distance(mask) / patch_size)


def edge_distance(mask: Bool[Array, "H W"]) -> Float[Array, "H W"]:
    """Return every pixel's distance to the nearest pixel on the other side of the mask's edge, in pixels.

    Exact and Euclidean, between centres, up to `REACH`; larger distances are infinite.
    """
    to_dynamic, to_static = _squared_distance(mask), _squared_distance(~mask)
    squared = jnp.where(mask, to_static, to_dynamic)
    return jnp.where(squared <= REACH**2, jnp.sqrt(squared), jnp.inf)


def _squared_distance(mask: Bool[Array, "H W"]) -> Float[Array, "H W"]:
    """Return the squared distance to the nearest True pixel: within columns first, then over columns up to `REACH`."""
    H, W = mask.shape
    rows = jnp.broadcast_to(jnp.arange(H, dtype=jnp.float32)[:, None], (H, W))
    far = float(4 * (REACH + max(H, W)))
    above = jax.lax.cummax(jnp.where(mask, rows, -far), axis=0)
    below = jax.lax.cummin(jnp.where(mask, rows, H + far), axis=0, reverse=True)
    column = jnp.minimum(rows - above, below - rows) ** 2
    padded = jnp.pad(column, ((0, 0), (REACH, REACH)), constant_values=far * far)

    def nearer(best, offset):
        shifted = jax.lax.dynamic_slice_in_dim(padded, offset, W, axis=1)
        return jnp.minimum(best, shifted + ((offset - REACH) ** 2).astype(best.dtype)), None

    return jax.lax.scan(nearer, column, jnp.arange(2 * REACH + 1))[0]


def _margin(saliency: Float[Array, "S H W"], dynamic: Bool[Array, "S H W"]) -> Float[Array, "S H W"]:
    """Return the saliency minus the threshold of the mask, clipped to the mask's side of 0.

    The threshold is midway between the largest static and the smallest dynamic saliency, for a full mask 1/2 below the
    smallest. Saliency and mask disagree where the mask was supplied by the user or smoothed. An empty mask has no edge.
    """
    low, high = jnp.where(dynamic, -jnp.inf, saliency).max(), jnp.where(dynamic, saliency, jnp.inf).min()
    low, high = jnp.where(jnp.isfinite(low), low, high - 1), jnp.where(jnp.isfinite(high), high, low + 1)
    margin = saliency - (low + high) / 2
    margin = jnp.where(dynamic, jnp.maximum(margin, 0), jnp.minimum(margin, -_SMALLEST))
    return jnp.where(dynamic.any(), margin, _STILL)


def _log_confidence(confidence: Float[Array, "*S"]) -> Float[Array, "*S"]:
    return jnp.log(jnp.clip(confidence, _SMALLEST, jnp.finfo(confidence.dtype).max / 4))
