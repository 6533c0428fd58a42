"""Point clouds against the truth: accuracy, completeness, distance, normals. Does not import jax."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import KDTree

from vggtjax.errors import InputError

_LEAF = 20  # points in a leaf of the tree: the fastest of 10, 20 and 40
_NOT_UNIT = 1e-2  # largest difference of the squared length of a normal from 1


class Statistics(NamedTuple):
    """Mean and median of distances, in the unit of the points."""

    mean: float
    median: float


class PointCloudErrors(NamedTuple):
    """Differences of two clouds; the distances are in the unit of the points.

    Attributes:
        accuracy: of the distance from every predicted point to the nearest true one.
        completeness: of the distance from every true point to the nearest predicted one.
        distance_chamfer: (accuracy + completeness) / 2, of the means and of the medians.
        normal_consistency: |cosine| between the normals of nearest neighbours, 0 to 1; None without normals.
    """

    accuracy: Statistics
    completeness: Statistics
    distance_chamfer: Statistics
    normal_consistency: float | None


def point_cloud_errors(
    predicted: Float[np.ndarray, "N 3"],
    truth: Float[np.ndarray, "M 3"],
    *,
    normals: tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "M 3"]] | None = None,
) -> PointCloudErrors:
    """Return accuracy, completeness and their mean, by exact nearest neighbours in float64.

    Args:
        predicted: points; they are not aligned, filtered or thinned here.
        truth: points in the same world and unit.
        normals: unit normals of the predicted and of the true points, as from `normals_of`. The consistency is the
            mean |cosine| from prediction to truth and the mean from truth to prediction, averaged. Their sign does
            not matter, and pairs with a NaN do not count.

    Raises:
        InputError: a cloud that is empty, not [N, 3] or not finite; normals of another shape, of another length than 1,
            or without a pair to compare.
    """
    predicted, truth = _cloud("predicted", predicted), _cloud("true", truth)
    distances, neighbours = _nearest(predicted, truth)
    true_distances, true_neighbours = _nearest(truth, predicted)
    accuracy, completeness = statistics(distances), statistics(true_distances)
    chamfer = Statistics(*((one + other) / 2 for one, other in zip(accuracy, completeness, strict=True)))
    consistency = None
    if normals is not None:
        ours, theirs = _checked_normals("predicted", normals[0], predicted), _checked_normals("true", normals[1], truth)
        consistency = (_cosine(ours, theirs[neighbours]) + _cosine(theirs, ours[true_neighbours])) / 2
    return PointCloudErrors(accuracy, completeness, chamfer, consistency)


def paired_distance(predicted: Float[np.ndarray, "N 3"], truth: Float[np.ndarray, "N 3"]) -> Statistics:
    """Return mean and median of ||X_truth - X_predicted|| of the points of one pixel.

    Its mean is never below the mean accuracy or completeness, as a nearest neighbour is at most as far away.

    Raises:
        InputError: as `point_cloud_errors`, and different numbers of points.
    """
    predicted, truth = _cloud("predicted", predicted), _cloud("true", truth)
    if len(predicted) != len(truth):
        raise InputError(f"{len(predicted)} predicted points and {len(truth)} true ones; expected pairs")
    return statistics(np.linalg.norm(predicted.astype(np.float64) - truth, axis=1))


def normals_of(points: Float[np.ndarray, "S H W 3"]) -> Float[np.ndarray, "S H W 3"]:
    """Return unit normals of points on the pixel grid: the cross product of central differences, right x down.

    Computed in float64, returned in the type of the points. NaN where undefined: on the border of a frame, next to a
    point that is not finite (so set points outside a mask to NaN), and where the neighbours are on one line. The
    differences step over the pixel, whose own point does not count.

    Raises:
        InputError: another shape than [S, H, W, 3].
    """
    points = np.asarray(points)
    if points.ndim != 4 or points.shape[3] != 3:
        raise InputError(f"points have shape {points.shape}; expected one for each pixel, [S, H, W, 3]")
    kind = points.dtype if np.issubdtype(points.dtype, np.floating) else np.float64
    normals = np.full(points.shape, np.nan, kind)
    for frame, frame_normals in zip(points, normals, strict=True):
        exact = np.where(np.isfinite(frame), frame, np.nan).astype(np.float64)
        cross = np.cross(exact[1:-1, 2:] - exact[1:-1, :-2], exact[2:, 1:-1] - exact[:-2, 1:-1])
        length = np.linalg.norm(cross, axis=2, keepdims=True)
        frame_normals[1:-1, 1:-1] = cross / np.where(length > 0, length, np.nan)
    return normals


def nearest_distances(points: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "M 3"]) -> Float64[np.ndarray, " N"]:
    """Return the distance from every point to the nearest of the others; errors as `point_cloud_errors`.

    Accuracy is the `statistics` of the distances from prediction to truth.
    """
    return _nearest(_cloud("first", points), _cloud("second", others))[0]


def statistics(distances: Float[np.ndarray, " N"]) -> Statistics:
    """Return mean and median of distances. Raises InputError if there is no distance."""
    distances = np.asarray(distances, np.float64)
    if not distances.size:
        raise InputError("no distances; expected at least 1")
    return Statistics(float(distances.mean()), float(np.median(distances)))


def _nearest(points, others) -> tuple[Float64[np.ndarray, " N"], Int64[np.ndarray, " N"]]:
    """Return distance and index of the nearest of the others, for every point."""
    tree = KDTree(others, leafsize=_LEAF, balanced_tree=False)  # cells cut in the middle: twice as fast to build
    distances, indices = tree.query(points, workers=-1)
    return np.asarray(distances), np.asarray(indices)


def _cosine(normals, neighbours) -> float:
    """Return the mean |cosine| of the pairs of normals without NaN."""
    cosine = np.einsum("ni,ni->n", normals.astype(np.float64), neighbours)
    cosine = cosine[~np.isnan(cosine)]
    if not len(cosine):
        raise InputError("no nearest neighbours both have a normal; expected some that are not NaN")
    return float(np.minimum(np.abs(cosine), 1).mean())


def _cloud(name: str, points) -> Float[np.ndarray, "N 3"]:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"the {name} points have shape {points.shape}; expected [N, 3]")
    if not len(points):
        raise InputError(f"the {name} cloud has no points; expected at least 1")
    if (wrong := int((~np.isfinite(points).all(axis=1)).sum())) > 0:
        raise InputError(f"{wrong} of {len(points)} {name} points are not finite; remove them from both clouds")
    return points


def _checked_normals(name: str, normals, points) -> Float[np.ndarray, "N 3"]:
    normals = np.asarray(normals)
    if normals.shape != points.shape:
        raise InputError(f"the {name} normals have shape {normals.shape}; expected {points.shape}, one for each point")
    length = np.linalg.norm(normals.astype(np.float64), axis=1)
    if (wrong := np.flatnonzero(np.abs(length**2 - 1) > _NOT_UNIT)).size:
        raise InputError(
            f"the {name} normal of point {wrong[0]} has length {length[wrong[0]]:.3g}; expected 1, or NaN for none"
        )
    return normals
