"""Saliency -> dynamic pixels -> dynamic tokens (4DVGGT-D, stage 1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.method.clustering import kmeans
from vggtjax.method.cues import normalise
from vggtjax.options import Threshold, odd_frames

BINS = 256
MOST_CLASSES = 4  # of multi-Otsu
CONSTANT = 1e-6  # nothing moves in a clip whose saliency has a smaller range


def upsample(saliency: Float[Array, "B S h w"], size: tuple[int, int]) -> Float[Array, "B S H W"]:
    """Resize bilinearly to pixels, with half-pixel centres."""
    return jax.image.resize(saliency, (*saliency.shape[:2], *size), "bilinear", antialias=False)


def otsu_threshold(values: Float[Array, ...], bins: int = BINS) -> Float[Array, ""]:
    """Return Otsu's threshold: the bin centre of the largest variance between the two classes.

    The histogram has `bins` bins from the smallest to the largest value, as scikit-image's `threshold_otsu`. Of equal
    centres the lowest is returned; of constant values, the value.
    """
    values = values.ravel()
    low, high = values.min(), values.max()
    width = (high - low) / bins
    index = jnp.floor((values - low) / jnp.where(width > 0, width, 1)).astype(jnp.int32)
    counts = jnp.bincount(jnp.clip(index, 0, bins - 1), length=bins) / values.size
    centres = low + width * (jnp.arange(bins) + 0.5)
    offsets = jnp.arange(bins) + 0.5  # means in units of bins, which keeps every sum of order one
    below, above = jnp.cumsum(counts), jnp.cumsum(counts[::-1])[::-1]
    mean_below = jnp.cumsum(counts * offsets) / jnp.maximum(below, 1e-12)
    mean_above = jnp.cumsum((counts * offsets)[::-1])[::-1] / jnp.maximum(above, 1e-12)
    between = below[:-1] * above[1:] * (mean_below[:-1] - mean_above[1:]) ** 2
    return jnp.where(width > 0, centres[jnp.argmax(between)], low)


def dynamic_pixels(
    saliency: Float[Array, "B S h w"], size: tuple[int, int], *, threshold: Threshold = "otsu"
) -> Bool[Array, "B S H W"]:
    """Return the dynamic pixels of every clip by one threshold for all pixels of the clip.

    A clip of constant saliency (one frame, or nothing moves) has no dynamic pixels.

    Args:
        saliency: of every patch, in [0, 1].
        size: height and width of the frames in pixels.
        threshold: "otsu" (at or above, 4DVGGT-D) or "multi-otsu" (above, VGGT4D), which is computed on the host.
    """

    def one_clip(pixels: Float[Array, "S H W"]) -> Bool[Array, "S H W"]:
        varies = pixels.max() - pixels.min() >= CONSTANT
        if threshold == "otsu":
            return (pixels >= otsu_threshold(pixels)) & varies
        scalar = jax.ShapeDtypeStruct((), jnp.float32)
        return (pixels > jax.pure_callback(_multi_otsu, scalar, pixels, vmap_method="sequential")) & varies

    return jax.vmap(one_clip)(upsample(saliency, size))


def mine_mask(
    saliency: Float[Array, "B S h w"],
    patch_tokens: Float[Array, "B S P C"],
    size: tuple[int, int],
    *,
    clusters: int = 0,
    threshold: Threshold = "otsu",
    smooth_frames: int = 1,
) -> Bool[Array, "B S H W"]:
    """Return a method's dynamic pixels: the saliency, averaged within clusters if requested, above a threshold.

    No gradient passes: a mask is a decision.

    Args:
        saliency: of every patch, in [0, 1].
        patch_tokens: the backbone's features.
        size: height and width of the mask.
        clusters: number of clusters of `smooth_by_clusters`; 0 for none.
        threshold: "otsu" or "multi-otsu".
        smooth_frames: odd number of frames over which the saliency is averaged before the threshold (see
            `smooth_over_time`; not in the papers).
    """
    saliency, patch_tokens = jax.lax.stop_gradient((saliency, patch_tokens))
    if clusters:
        saliency = smooth_by_clusters(saliency, patch_tokens, clusters)
    saliency = smooth_over_time(saliency, smooth_frames)
    return dynamic_pixels(saliency, size, threshold=threshold)


def smooth_by_clusters(
    saliency: Float[Array, "B S h w"], patch_tokens: Float[Array, "B S P C"], clusters: int
) -> Float[Array, "B S h w"]:
    """Give every token the mean saliency of its cluster, min-max normalised per frame again (VGGT4D).

    The backbone's features of all frames of a clip are clustered together.
    """

    def one_clip(clip: tuple[Array, Array]) -> Float[Array, "S h w"]:
        values, features = clip
        labels = kmeans(jax.random.key(0), features.reshape(-1, features.shape[-1]), clusters).labels
        return cluster_means(values, labels.reshape(values.shape), clusters)

    return jax.lax.map(one_clip, (saliency, patch_tokens.astype(jnp.float32)))


def smooth_over_time(saliency: Float[Array, "B S h w"], frames: int) -> Float[Array, "B S h w"]:
    """Average every patch over `frames` frames around its own; at the ends of the clip, over the existing ones.

    Patches are averaged at fixed places in the picture, which suits dense clips of slow cameras.

    Raises InputError for an even number.
    """
    frames = odd_frames(frames)
    if frames == 1:
        return saliency
    S, reach = saliency.shape[1], frames // 2
    near = jnp.abs(jnp.arange(S)[:, None] - jnp.arange(S)[None]) <= reach
    weights = near / near.sum(axis=1, keepdims=True)
    return jnp.einsum("st,bthw->bshw", weights, saliency, precision="highest")


def cluster_means(saliency: Float[Array, "S h w"], labels: Int[Array, "S h w"], clusters: int) -> Float[Array, "S h w"]:
    """Return every token's mean over its cluster, min-max normalised per frame."""
    flat = labels.ravel()
    total = jnp.zeros(clusters).at[flat].add(saliency.ravel())
    count = jnp.zeros(clusters).at[flat].add(1)
    mean = (total / jnp.maximum(count, 1))[flat]
    return normalise(mean.reshape(1, len(saliency), -1))[0].reshape(saliency.shape)


def multi_otsu_threshold(values: np.ndarray) -> float:
    """Return the highest threshold of Otsu's best partition into two to four classes (VGGT4D), on the host.

    The number of classes K is that of the largest variance of the classes' means over sqrt(K), among numbers up to that
    of distinct values. Of constant values, the value is returned.
    """
    from skimage.filters import threshold_multiotsu

    values = np.asarray(values, np.float32)
    best, best_score = float(values.max()), -np.inf
    if best - values.min() < CONSTANT:
        return best
    distinct = np.count_nonzero(np.histogram(values, BINS)[0])
    for classes in range(2, min(MOST_CLASSES, distinct) + 1):
        thresholds = threshold_multiotsu(values, classes=classes, nbins=BINS)
        regions = np.digitize(values, bins=thresholds)
        if len(np.unique(regions)) < classes:
            continue
        score = np.var([values[regions == i].mean() for i in range(classes)]) / classes**0.5
        if score > best_score:
            best, best_score = float(thresholds[-1]), score
    return best


def _multi_otsu(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    threshold = multi_otsu_threshold(values) if np.isfinite(values).all() else np.nan  # no value is above NaN
    return np.asarray(threshold, np.float32)


def dynamic_tokens(
    mask: Bool[Array, "B S H W"] | Float[Array, "B S H W"], patch_size: int
) -> Bool[Array, "B S h w"] | Float[Array, "B S h w"]:
    """Return the tokens with at least one dynamic pixel; of shares in [0, 1], the largest of each token's pixels."""
    B, S, H, W = mask.shape
    return mask.reshape(B, S, H // patch_size, patch_size, W // patch_size, patch_size).max(axis=(3, 5))
