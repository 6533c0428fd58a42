"""Saliency -> dynamic pixels -> dynamic tokens (4DVGGT-D, stage 1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import Threshold
from vggtjax.method.clustering import kmeans
from vggtjax.method.cues import normalise
from vggtjax.options import odd_frames

BINS = 256
MOST_CLASSES = 4  # of multi-Otsu
CONSTANT = 1e-6  # nothing moves in a clip whose saliency has a smaller range
_SMALLEST_WIDTH = jnp.finfo(jnp.float32).tiny  # of a bin of constant values


def upsample(saliency: Float[Array, "B S h w"], size: tuple[int, int]) -> Float[Array, "B S H W"]:
    """Resize bilinearly to pixels, with half-pixel centres."""
    return jax.image.resize(saliency, (*saliency.shape[:2], *size), "bilinear", antialias=False)


def otsu_threshold(values: Float[Array, "S ..."], bins: int = BINS) -> Float[Array, ""]:
    """Return Otsu's threshold: the bin centre of the largest variance between the two classes.

    The histogram has `bins` bins from the smallest to the largest value, as scikit-image's `threshold_otsu`. Of equal
    centres the lowest is returned; of constant values, the value.
    """
    low, high = values.min(), values.max()
    index, centres = _binned(values, low, high, bins)
    counts = jnp.bincount(index, length=bins)
    counts = counts.astype(values.dtype) / counts.sum().astype(values.dtype)
    offsets = jnp.arange(bins, dtype=values.dtype) + 0.5  # means in units of bins, which keeps every sum of order one
    below, above = jnp.cumsum(counts), jnp.cumsum(counts[::-1])[::-1]
    mean_below = jnp.cumsum(counts * offsets) / jnp.maximum(below, 1e-12)
    mean_above = jnp.cumsum((counts * offsets)[::-1])[::-1] / jnp.maximum(above, 1e-12)
    between = below[:-1] * above[1:] * (mean_below[:-1] - mean_above[1:]) ** 2
    return jnp.where(high > low, centres[jnp.argmax(between)], low)


def find_threshold(pixels: Float[Array, "S H W"], threshold: Threshold = "otsu") -> Float[Array, ""]:
    """Return the value at which a clip's saliency is cut."""
    return otsu_threshold(pixels) if threshold == "otsu" else multi_otsu_threshold(pixels)


def dynamic_pixels(
    saliency: Float[Array, "B S h w"], size: tuple[int, int], *, threshold: Threshold = "otsu"
) -> Bool[Array, "B S H W"]:
    """Return the dynamic pixels of every clip by one threshold for all pixels of the clip.

    A clip of constant saliency (one frame, or nothing moves) has no dynamic pixels.

    Args:
        saliency: of every patch, in [0, 1].
        size: height and width of the frames in pixels.
        threshold: "otsu" (at or above, 4DVGGT-D) or "multi-otsu" (above, VGGT4D).
    """

    def one_clip(pixels: Float[Array, "S H W"]) -> Bool[Array, "S H W"]:
        varies = pixels.max() - pixels.min() >= CONSTANT
        cut = find_threshold(pixels, threshold)
        return (pixels >= cut if threshold == "otsu" else pixels > cut) & varies

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
        saliency: of every patch, in [0, 1]; a patch whose saliency is not finite counts as still.
        patch_tokens: the backbone's features.
        size: height and width of the mask.
        clusters: number of clusters of `smooth_by_clusters`; 0 for none.
        threshold: "otsu" or "multi-otsu".
        smooth_frames: odd number of frames over which the saliency is averaged before the threshold (see
            `smooth_over_time`; not in the papers).
    """
    saliency, patch_tokens = jax.lax.stop_gradient((saliency, patch_tokens))
    saliency = jnp.where(jnp.isfinite(saliency), saliency, 0)  # else one value would empty the masks of all frames
    if clusters:
        saliency = smooth_by_clusters(saliency, patch_tokens, clusters)
    return dynamic_pixels(smooth_over_time(saliency, smooth_frames), size, threshold=threshold)


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


def smooth_over_time(saliency: Float[Array, "B S h w"], smooth_frames: int) -> Float[Array, "B S h w"]:
    """Average every patch over `smooth_frames` frames around its own; at the ends of the clip, over the existing ones.

    Patches are averaged at fixed places in the picture, which suits dense clips of slow cameras.

    Raises InputError for an even number.
    """
    smooth_frames = odd_frames(smooth_frames)
    if smooth_frames == 1:
        return saliency
    number = jnp.arange(saliency.shape[1])
    near = (jnp.abs(number[:, None] - number[None]) <= smooth_frames // 2).astype(saliency.dtype)
    weights = near / near.sum(axis=1, keepdims=True)
    return jnp.einsum("st,bthw->bshw", weights, saliency, precision="highest")


def cluster_means(saliency: Float[Array, "S h w"], labels: Int[Array, "S h w"], clusters: int) -> Float[Array, "S h w"]:
    """Return every token's mean over its cluster, min-max normalised per frame."""
    flat, zeros = labels.ravel(), jnp.zeros(clusters)
    total, count = zeros.at[flat].add(saliency.ravel()), zeros.at[flat].add(1)
    mean = (total / jnp.maximum(count, 1))[flat]
    return normalise(mean.reshape(1, len(saliency), -1))[0].reshape(saliency.shape)


def _binned(
    values: Float[Array, "S ..."], low: Float[Array, ""], high: Float[Array, ""], bins: int
) -> tuple[Int[Array, " n"], Float[Array, " bins"]]:
    """Return the bin of every value among equal ones from low to high, and the centres of all bins.

    Constant values, and those of a range that is not finite, are in bin 0; values below low in a bin below 0.
    """
    width = (high - low) / bins
    index = jnp.nan_to_num((values.ravel() - low) / jnp.maximum(width, _SMALLEST_WIDTH))
    return jnp.minimum(jnp.floor(index), bins - 1).astype(jnp.int32), low + width * (
        jnp.arange(bins, dtype=values.dtype) + 0.5
    )


def multi_otsu_threshold(values: Float[Array, "S ..."], bins: int = BINS) -> Float[Array, ""]:
    """Return the highest threshold of Otsu's best partition into two to four classes (VGGT4D).

    Partitions are those of scikit-image's `threshold_multiotsu`. The number of classes K is that of the largest
    variance of the classes' means over sqrt(K), among numbers up to that of bins with values. Of constant values the
    value is returned; of values that are not all finite, NaN.
    """
    low, high = values.min(), values.max()
    index, centres = _binned(values, low, high, bins)
    counts = jnp.bincount(index, length=bins)
    between = _between_classes(counts.astype(values.dtype) / values.size)
    best, best_score = high, jnp.asarray(-jnp.inf)
    for classes in range(2, MOST_CLASSES + 1):
        thresholds = centres[_partition(between, classes)]
        region = (values[..., None] >= thresholds[(None,) * values.ndim]).sum(axis=-1)
        sizes, sums = zip(*(_size_and_sum(values, region == i) for i in range(classes)), strict=True)
        mean = jnp.stack(sums) / jnp.maximum(jnp.stack(sizes), 1).astype(values.dtype)
        score = jnp.where(jnp.stack(sizes).all(), mean.var() / classes**0.5, -jnp.inf)
        wins = (jnp.count_nonzero(counts) >= classes) & (score > best_score)
        best, best_score = jnp.where(wins, thresholds[-1], best), jnp.where(wins, score, best_score)
    return jnp.where(jnp.isfinite(high - low), jnp.where(high - low < CONSTANT, high, best), jnp.nan)


def _between_classes(shares: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Return the part of the class of bins i to j in the variance between classes, 0 for classes without values.

    As in scikit-image, bin 0 counts as bin 1 does, and adds nothing as a class of its own.
    """
    n = len(shares)
    mass, moment = (
        jnp.pad(jnp.cumsum(x), (1, 0)) for x in (shares, jnp.arange(n, dtype=shares.dtype).clip(1) * shares)
    )
    mass, moment = (x[None, 1:] - x[:n, None] for x in (mass, moment))
    is_class = (mass > 0) & (jnp.arange(n)[:, None] <= jnp.arange(n)[None])
    return jnp.where(is_class, moment**2 / jnp.where(is_class, mass, 1), 0).at[0, 0].set(0)


def _partition(between: Float[Array, "n n"], classes: int) -> Int[Array, " K-1"]:
    """Return the last bins of all classes but the highest, of the best partition; of equally good ones the first.

    The best partition of the bins from j on into k classes follows from those into k - 1 classes.
    """
    n = len(between)
    value, ends = between[:, -1], []  # of the bins from j on as one class
    for _ in range(classes - 1):
        rest = jnp.append(value[1:], -jnp.inf)  # of the bins after t
        total = jnp.where(jnp.arange(n)[:, None] <= jnp.arange(n)[None], between + rest[None], -jnp.inf)
        ends.append(jnp.argmax(total, axis=1))
        value = total.max(axis=1)
    start, found = jnp.zeros((), jnp.int32), []
    for end in reversed(ends):
        found.append(end[start])
        start = jnp.minimum(end[start] + 1, n - 1)
    return jnp.stack(found)


def _size_and_sum(values: Float[Array, "S ..."], member: Bool[Array, "S ..."]) -> tuple[Array, Array]:
    """Return the number and the sum of the members: a sum of sums over frames, which keeps float32 exact enough."""
    sums = jnp.where(member, values, 0).reshape(len(values), -1).sum(axis=1)
    return member.sum(), jax.lax.optimization_barrier(sums).sum()


def dynamic_tokens(
    mask: Bool[Array, "B S H W"] | Float[Array, "B S H W"], patch_size: int
) -> Bool[Array, "B S h w"] | Float[Array, "B S h w"]:
    """Return the tokens with at least one dynamic pixel; of shares in [0, 1], the largest of each token's pixels."""
    B, S, H, W = mask.shape
    return mask.reshape(B, S, H // patch_size, patch_size, W // patch_size, patch_size).max(axis=(3, 5))
