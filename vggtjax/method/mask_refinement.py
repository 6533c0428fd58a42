"""Mask refinement by projection (VGGT4D, stage 3): points that agree with the static pixels of other frames are static.

In each frame, the points under the coarse mask are grouped by k-means. Every group is projected into all other frames
and compared with their static pixels in depth and colour. Groups that agree are removed from the mask.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from vggtjax.cameras import unproject
from vggtjax.errors import InputError
from vggtjax.method.clustering import kmeans, nearest_centre
from vggtjax.network.heads.sampling import bilinear
from vggtjax.network.precision import full_precision
from vggtjax.progress import Progress, no_progress

CLUSTERS = 30
RESTARTS = 4  # of k-means
FITTED = 4096  # points of a frame, evenly drawn, for fitting the cluster centres; all points are labelled
NEIGHBOURS = 20  # of a point, including itself
OUTLIER_SIGMA = 2.5
LEAST_SHARE = 0.05  # of a group's projections that must be comparable
MOST_LOSS = 0.1
OCCLUSION = 0.01  # depth by which a point may lie behind the depth of its target pixel
TOO_FEW = 1e10  # loss of a group with too few comparable projections
SAMPLES_AT_ONCE = 1 << 18  # projected points, a bound on memory
_BUCKET = 2048  # points are padded to a multiple, so that masks of similar size share a compilation
_CLOSING = np.array([[0, 0, 1, 0, 0], [1] * 5, [1] * 5, [1] * 5, [0, 0, 1, 0, 0]], bool)  # OpenCV's 5 x 5 ellipse


class ClusterLosses(NamedTuple):
    """Differences of every cluster from other frames: means over its comparable projections."""

    depth: Float[Array, "S K"]
    rgb: Float[Array, "S K"]  # absolute difference, summed over the channels
    counted: Int[Array, "S K"]  # comparable projections
    points: Int[Array, "S K"]

    @property
    def total(self) -> Float[Array, "S K"]:
        """Depth plus mean over channels of colour; TOO_FEW for too few comparable projections."""
        S = self.depth.shape[0]
        counted, points = (x.astype(self.depth.dtype) for x in (self.counted, self.points))
        enough = (counted >= LEAST_SHARE * (S - 1) * points) & (counted > 0)
        return jnp.where(enough, self.depth + self.rgb / 3, TOO_FEW)


def refine_masks(
    images: Float[np.ndarray, "S H W 3"],
    depth: Float[np.ndarray, "S H W"],
    dynamic_mask: Bool[np.ndarray, "S H W"],
    camera_from_world: Float[np.ndarray, "S 3 4"],
    intrinsics: Float[np.ndarray, "S 3 3"],
    *,
    valid: Bool[np.ndarray, "S H W"] | None = None,
    clusters: int = CLUSTERS,
    seed: int = 0,
    progress: Progress | None = None,
) -> Bool[np.ndarray, "S H W"]:
    """Return the dynamic mask without points that agree with other frames, closed and dilated (VGGT4D, stage 3).

    Args:
        images: RGB in [0, 1].
        depth: z in the camera, in VGGT's unit: scenes are about 1 away, and the thresholds are lengths.
        dynamic_mask: the coarse mask; an empty mask stays empty.
        camera_from_world: OpenCV cameras of little noise.
        intrinsics: in pixels.
        valid: False on padding, which is neither compared nor dynamic; None without padding.
        clusters: groups per frame.
        seed: of k-means.
        progress: called with the frames searched for outliers and their number.

    Raises InputError for inconsistent shapes, or wrong types.
    """
    _check(images, depth, dynamic_mask, camera_from_world, intrinsics, valid)
    S = len(depth)
    valid = np.ones_like(dynamic_mask) if valid is None else valid
    dynamic_mask = dynamic_mask & valid
    if S < 2 or not dynamic_mask.any():
        return dynamic_mask
    points = unproject(depth, intrinsics, camera_from_world, pixel_offset=0.5)
    inside = np.zeros_like(dynamic_mask)
    for frame in range(S):
        if dynamic_mask[frame].any():
            inside[frame] = dynamic_mask[frame] & ~statistical_outliers(points[frame], valid[frame])
        (progress or no_progress)(frame + 1, S)
    if not inside.any():
        return inside
    most = int(inside.sum(axis=(1, 2)).max())
    count = min(-(-most // _BUCKET) * _BUCKET, depth[0].size)
    index, weight = _packed(inside, count)
    chosen = np.take_along_axis(points.reshape(S, -1, 3), index[..., None], axis=1)
    chosen[~weight] = 0  # depth outside the mask may be NaN
    labels = cluster_points(jax.random.key(seed), chosen, weight, clusters)
    hidden = dynamic_mask | ~valid
    losses = cluster_losses(images, depth, hidden, camera_from_world, intrinsics, index, weight, labels, clusters)
    static = np.asarray(losses.total <= MOST_LOSS)  # [S, K]
    moves = ~np.take_along_axis(static, np.asarray(labels), axis=1) & weight
    refined = np.zeros((S, depth[0].size), bool)
    np.put_along_axis(refined, index, moves, axis=1)
    return np.stack([_smoothed(mask) for mask in refined.reshape(depth.shape)]) & valid


def statistical_outliers(
    points: Float[np.ndarray, "H W 3"], valid: Bool[np.ndarray, "H W"] | None = None
) -> Bool[np.ndarray, "H W"]:
    """Return the points whose mean distance to their nearest neighbours is 2.5 standard deviations above the mean.

    Invalid points and points that are not finite are outliers too, and not neighbours of other points.
    """
    flat = points.reshape(-1, 3)
    outlier = np.logical_not(np.isfinite(flat).all(axis=1, keepdims=True))[:, 0]
    if valid is not None:
        outlier |= ~valid.ravel()
    known = flat[~outlier]
    if len(known):
        distances, _ = scipy.spatial.KDTree(known, leafsize=32).query(known, k=min(NEIGHBOURS, len(known)), workers=-1)
        distance = distances.reshape(len(known), -1).mean(axis=1)
        outlier[~outlier] = distance > distance.mean() + OUTLIER_SIGMA * distance.std()
    return outlier.reshape(points.shape[:2])


@partial(jax.jit, static_argnames="clusters")
def cluster_points(
    key: Array, points: Float[Array, "S N 3"], weight: Bool[Array, "S N"], clusters: int = CLUSTERS
) -> Int[Array, "S N"]:
    """Group the points of every frame by k-means; points of weight 0 are labelled but move no centre."""
    keys = jax.random.split(key, points.shape[0])
    fitted = min(FITTED, points.shape[1])

    def one_frame(frame: tuple[Array, Array, Array]) -> Int[Array, " N"]:
        key, points, is_real = frame
        count = jnp.maximum(is_real.sum(), 1)  # real points come first
        drawn = jnp.where(
            count > fitted,
            (jnp.arange(fitted, dtype=points.dtype) * (count / fitted)).astype(jnp.int32),
            jnp.arange(fitted),
        )
        centres = kmeans(key, points[drawn], clusters, is_real[drawn], restarts=RESTARTS).centres
        return nearest_centre(points, centres)

    return jax.lax.map(one_frame, (keys, points, weight))


@partial(jax.jit, static_argnames="clusters")
@full_precision()
def cluster_losses(
    images: Float[Array, "S H W 3"],
    depth: Float[Array, "S H W"],
    dynamic_mask: Bool[Array, "S H W"],
    camera_from_world: Float[Array, "S 3 4"],
    intrinsics: Float[Array, "S 3 3"],
    index: Int[Array, "S N"],
    weight: Bool[Array, "S N"],
    labels: Int[Array, "S N"],
    clusters: int = CLUSTERS,
) -> ClusterLosses:
    """Compare every cluster with the static pixels of the other frames.

    A projection is comparable on a static pixel inside the frame, in front of the camera, and not behind the pixel's
    depth. Depth is sampled at the nearest pixel, colour and mask bilinearly.

    `index` holds the pixels of the points in row-major order, `labels` their clusters; `weight` is False for padding.
    The number of `clusters` is static. Other arguments are as for `refine_masks`.
    """
    S, H, W = depth.shape
    N = index.shape[1]
    at_once = max(n for n in range(1, S + 1) if S % n == 0 and (n == 1 or n * N <= SAMPLES_AT_ONCE))
    shown = jnp.concatenate([images, dynamic_mask[..., None].astype(images.dtype)], axis=-1)
    shown = jnp.pad(shown, ((0, 0), (0, 1), (0, 1), (0, 0)))  # 0 outside
    targets = (jnp.arange(S), shown, depth, camera_from_world, intrinsics)
    targets = jax.tree.map(lambda x: x.reshape(S // at_once, at_once, *x.shape[1:]), targets)

    def one_frame(source):
        frame, pixels, is_real, label = source
        points = unproject(depth[frame], intrinsics[frame], camera_from_world[frame], pixel_offset=0.5)
        world = points.reshape(-1, 3)[pixels]
        colour = images[frame].reshape(-1, 3)[pixels]
        member = jax.nn.one_hot(label, clusters) * is_real[:, None].astype(jnp.float32)

        def one_target(target):
            number, shown, target_depth, pose, camera = target
            local = world @ pose[:, :3].T + pose[:, 3][None]
            projected = local @ camera.T
            u, v = projected[:, 0] / projected[:, 2], projected[:, 1] / projected[:, 2]
            inside = (u > 0) & (u < W) & (v > 0) & (v < H) & (local[:, 2] > 0)
            u, v = jnp.where(inside, u, 0), jnp.where(inside, v, 0)
            sampled_depth = _nearest(target_depth, u, v)
            sampled = bilinear(shown, jnp.stack([u, v], axis=-1))
            counts = inside & (local[:, 2] - OCCLUSION < sampled_depth) & (sampled_depth < jnp.inf)
            counts &= (sampled[:, 3] <= 0.5) & (number != frame)
            depth_error = jnp.abs(sampled_depth - local[:, 2])
            rgb_error = jnp.abs(sampled[:, :3] - colour).sum(axis=-1)
            values = jnp.stack([jnp.ones_like(depth_error), depth_error, rgb_error], axis=-1)
            return jnp.einsum("nk,nv->kv", member, jnp.where(counts[:, None], values, 0))

        sums = jax.lax.map(lambda batch: jax.vmap(one_target)(batch).sum(axis=0), targets).sum(axis=0)
        return sums, member.sum(axis=0)

    sums, points = jax.lax.map(one_frame, (jnp.arange(S), index, weight, labels))
    mean = sums[..., 1:] / jnp.maximum(sums[..., :1], 1)
    return ClusterLosses(mean[..., 0], mean[..., 1], sums[..., 0].astype(jnp.int32), points.astype(jnp.int32))


def _nearest(image: Float[Array, "H W"], u: Float[Array, " N"], v: Float[Array, " N"]) -> Float[Array, " N"]:
    """Sample at pixel centres u, v that count from 0; 0 outside."""
    H, W = image.shape
    column, row = jnp.round(u).astype(jnp.int32), jnp.round(v).astype(jnp.int32)
    inside = (column < W) & (row < H)
    return jnp.where(inside, image[jnp.minimum(row, H - 1), jnp.minimum(column, W - 1)], 0)


def _check(images, depth, dynamic_mask, camera_from_world, intrinsics, valid) -> None:
    S, H, W = depth.shape if depth.ndim == 3 else (0, 0, 0)
    shapes = {
        "images": (images, (S, H, W, 3)),
        "depth": (depth, (S, H, W)),
        "dynamic_mask": (dynamic_mask, (S, H, W)),
        "camera_from_world": (camera_from_world, (S, 3, 4)),
        "intrinsics": (intrinsics, (S, 3, 3)),
        "valid": (dynamic_mask if valid is None else valid, (S, H, W)),
    }
    for name, (array, shape) in shapes.items():
        kind = "bool" if name in ("dynamic_mask", "valid") else "floating point"
        if array.shape != shape or (array.dtype != bool if kind == "bool" else array.dtype.kind != "f"):
            raise InputError(f"{name} is {array.dtype} {array.shape}; expected {kind} {shape}")


def _packed(inside: Bool[np.ndarray, "S H W"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of every frame's mask as indices [S, count], and which of the indices are real.

    Padding names distinct pixels outside the mask, so that every pixel is named at most once.
    """
    order = np.argsort(~inside.reshape(len(inside), -1), axis=1, kind="stable")[:, :count]
    return order.astype(np.int32), np.take_along_axis(inside.reshape(len(inside), -1), order, axis=1)


def _smoothed(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Close with OpenCV's 5 x 5 ellipse, then dilate with a full 3 x 3; pixels beyond the edge change neither."""
    closed = scipy.ndimage.binary_erosion(scipy.ndimage.binary_dilation(mask, _CLOSING), _CLOSING, border_value=1)
    return scipy.ndimage.binary_dilation(closed, np.ones((3, 3), bool))
