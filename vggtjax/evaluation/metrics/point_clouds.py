"""Point clouds against the truth: accuracy, completeness, distance, normals. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.spatial import KDTree

from vggtjax.errors import InputError
from vggtjax.progress import Progress, no_progress

_CHUNK = 2**20  # points of one look-up
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
    progress: Progress | None = None,
) -> PointCloudErrors:
    """Return accuracy, completeness and their mean, by exact nearest neighbours in float64.

    The tree of one cloud is in memory at a time: about 50 bytes for each of its points, and 8 for each point of the
    other.

    Args:
        predicted: points; they are not aligned, filtered or thinned here.
        truth: points in the same world and unit.
        normals: unit normals of the predicted and of the true points, as from `normals_of`. The consistency is the
            mean |cosine| from prediction to truth and the mean from truth to prediction, averaged. Their sign does
            not matter, and pairs with a NaN do not count.
        progress: called with the number of points looked up and of all points, N + M.

    Raises:
        InputError: a cloud that is empty, not [N, 3] or not finite; normals of another shape, of another length than 1,
            or without a pair to compare.
    """
    predicted, truth = _cloud("predicted", predicted), _cloud("true", truth)
    predicted_normals = true_normals = None
    if normals is not None:
        predicted_normals = _checked_normals("predicted", normals[0], predicted)
        true_normals = _checked_normals("true", normals[1], truth)
    tell, total = progress or no_progress, len(predicted) + len(truth)

    def look_up(source, target, source_normals, target_normals, before: int):
        distances, consistency = _nearest(
            source, target, source_normals, target_normals, lambda done: tell(before + done, total)
        )
        return statistics(distances), consistency

    accuracy, of_predicted = look_up(predicted, truth, predicted_normals, true_normals, 0)
    completeness, of_true = look_up(truth, predicted, true_normals, predicted_normals, len(predicted))
    chamfer = Statistics(*((one + other) / 2 for one, other in zip(accuracy, completeness, strict=True)))
    consistency = None if of_predicted is None or of_true is None else (of_predicted + of_true) / 2
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
    distances = np.empty(len(truth))
    for part in _chunks(len(truth)):
        distances[part] = np.linalg.norm(predicted[part].astype(np.float64) - truth[part], axis=1)
    return statistics(distances)


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


def nearest_distances(
    points: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "M 3"], *, progress: Progress | None = None
) -> Float64[np.ndarray, " N"]:
    """Return the distance from every point to the nearest of the others; progress and errors as `point_cloud_errors`.

    Accuracy is the `statistics` of the distances from prediction to truth.
    """
    points, others = _cloud("first", points), _cloud("second", others)
    tell = progress or no_progress
    return _nearest(points, others, None, None, lambda done: tell(done, len(points)))[0]


def statistics(distances: Float[np.ndarray, " N"]) -> Statistics:
    """Return mean and median of distances. Raises InputError if there is no distance."""
    distances = np.asarray(distances, np.float64)
    if not distances.size:
        raise InputError("no distances; expected at least 1")
    return Statistics(float(distances.mean()), float(np.median(distances)))


def _nearest(
    source, target, source_normals, target_normals, advance: Callable[[int], object]
) -> tuple[Float64[np.ndarray, " N"], float | None]:
    """Look up every point of `source` in a tree of `target`; return distances and the consistency of normals."""
    tree = KDTree(target, leafsize=_LEAF, balanced_tree=False)  # cells cut in the middle: twice as fast to build
    distances = np.empty(len(source))
    cosines, counted = 0.0, 0
    for part in _chunks(len(source)):
        distances[part], indices = tree.query(source[part], workers=-1)
        neighbours = np.asarray(indices)
        if source_normals is not None:
            cosine = _cosines(source_normals[part], target_normals, neighbours)
            cosines, counted = cosines + float(cosine.sum()), counted + len(cosine)
        advance(part.stop)
    if source_normals is not None and not counted:
        raise InputError("no nearest neighbours both have a normal; expected some that are not NaN")
    return distances, cosines / counted if counted else None


def _cosines(normals, others, neighbours: Int[np.ndarray, " N"]) -> Float64[np.ndarray, " K"]:
    """Return |cosine| of the pairs of normals without NaN, at most 1."""
    cosine = np.einsum("ni,ni->n", normals.astype(np.float64), others[neighbours])
    return np.minimum(np.abs(cosine[~np.isnan(cosine)]), 1)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK))


def _cloud(name: str, points) -> Float[np.ndarray, "N 3"]:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"the {name} points have shape {points.shape}; expected [N, 3]")
    if not len(points):
        raise InputError(f"the {name} cloud has no points; expected at least 1")
    if (wrong := sum(int((~np.isfinite(points[part]).all(axis=1)).sum()) for part in _chunks(len(points)))) > 0:
        raise InputError(f"{wrong} of {len(points)} {name} points are not finite; remove them from both clouds")
    return points


def _checked_normals(name: str, normals, points) -> Float[np.ndarray, "N 3"]:
    normals = np.asarray(normals)
    if normals.shape != points.shape:
        raise InputError(f"the {name} normals have shape {normals.shape}; expected {points.shape}, one for each point")
    for part in _chunks(len(normals)):
        length = np.linalg.norm(normals[part].astype(np.float64), axis=1)
        if (wrong := np.flatnonzero(np.abs(length**2 - 1) > _NOT_UNIT)).size:
            first = part.start + wrong[0]
            raise InputError(
                f"the {name} normal of point {first} has length {length[wrong[0]]:.3g}; expected 1, or NaN for none"
            )
    return normals
