"""Metric scale of a result: from a baseline, the cameras' height, or some known depths. Does not import jax."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from vggtjax.cameras import camera_centres
from vggtjax.errors import InputError
from vggtjax.pipeline.known.depths import DepthSamples
from vggtjax.pipeline.known.options import Baseline
from vggtjax.results.result import Result

_LEAST_BASELINE = 1e-3  # median depths; below it two cameras stand at one place
_POINTS = 20_000  # of the clip, evenly drawn, for the floor
_TRIES = 500  # planes
_REFINEMENTS = 5
_THICK = 0.05  # of the floor on either side, in heights of the cameras above it
_TILT = 30.0  # degrees between the floor's normal and the cameras' mean down
_LEAST_FLOOR = 0.03  # share of the points
_MANY, _FALLING = 1000, -0.3  # known depths, and the correlation of their logarithms with the predicted ones
_TUKEY = 4.685  # standard deviations from which on values count nothing: 95 % as efficient as the mean
_QUARTILE = 0.6745  # standard deviations, between which and its negative half of a normal distribution lies
_LEAST_SPREAD = 1e-6  # of logarithms: that of a few exact depths may be 0
_ROUNDS, _SETTLED = 100, 1e-6  # of the weights; and the step, in reaches, after which they stay

logger = logging.getLogger(__name__)


class MetricScale(NamedTuple):
    """Metres per unit of a result, and how it was found, in one sentence."""

    factor: float
    note: str


def from_baseline(result: Result, baseline: Baseline) -> MetricScale:
    """Return the scale that gives two cameras their distance.

    Raises InputError for cameras that stand at one place.
    """
    centres = camera_centres(result.camera_from_world.astype(np.float64))
    distance = float(np.linalg.norm(centres[baseline.first] - centres[baseline.second]))
    depth = result.depth[result.valid_pixels]
    middle = float(np.median(depth)) if depth.size else 1.0
    if distance <= _LEAST_BASELINE * middle:
        raise InputError(
            f"the cameras of frames {baseline.first} and {baseline.second} are predicted {distance / middle:.1e} "
            "median depths apart, which is no motion; expected two frames between which the camera moves"
        )
    return MetricScale(
        baseline.metres / distance,
        f"{baseline.metres:g} m between frames {baseline.first} and {baseline.second}, which are "
        f"{distance / middle:.3f} median depths apart",
    )


def from_camera_height(result: Result, height: float) -> MetricScale:
    """Return the scale that gives the cameras their mean height above the floor.

    The floor is the plane below all cameras, about level as the cameras stand, with the most static points (RANSAC,
    then least squares on its points; the same points for the same result). Raises InputError where there is none.
    """
    cameras = camera_centres(result.camera_from_world.astype(np.float64))
    points = result.world_points()[_reliable_pixels(result)].astype(np.float64)
    points = points[:: max(1, len(points) // _POINTS)]
    if len(points) < 100:
        raise InputError(
            f"camera_height needs at least 100 static points with confident depth, and there are {len(points)}; give a "
            "baseline or known depths"
        )
    down = result.camera_from_world[:, 1, :3].astype(np.float64).mean(axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-9)
    plane, share = _floor(points, cameras, down)
    if plane is None or share < _LEAST_FLOOR:
        raise InputError(
            f"camera_height finds no floor: the largest plane below the cameras has {share:.1%} of the static points; "
            f"expected at least {_LEAST_FLOOR:.0%}, so give a baseline or known depths"
        )
    above = plane[3] - cameras @ plane[:3]
    return MetricScale(
        height / float(above.mean()),
        f"{height:g} m above a floor with {share:.0%} of the static points; the cameras' heights above it spread by "
        f"{above.std() / above.mean():.1%}",
    )


def from_depths(result: Result, known: DepthSamples, name: str, *, robust: bool = False) -> MetricScale:
    """Return the median of known over predicted depth; with `robust` the mean of those that agree.

    A median moves with outliers on one side: with 30 % of them it is the 71st hundredth of the others. Tukey's biweight
    gives values far from the others no weight (Beaton and Tukey, 1974); it starts in the shortest interval with half of
    all values, and takes their spread from its length (Rousseeuw and Leroy, 1988).

    Raises InputError where no depth is predicted at these places.
    """
    predicted = result.depth[known.frames, known.rows, known.columns].astype(np.float64)
    used = result.valid_pixels[known.frames, known.rows, known.columns]
    if not used.any():
        raise InputError(f"{name} has no depth where one is predicted; expected places with points in the result")
    depths, predicted = np.log(known.depth[used]), np.log(predicted[used])
    varies = min(np.ptp(depths), np.ptp(predicted)) > 0  # of a constant there is no correlation
    if len(depths) >= _MANY and varies and np.corrcoef(depths, predicted)[0, 1] < _FALLING:
        logger.warning("the depths of %s fall where the prediction rises; are they disparities, not metres?", name)
    ratio = depths - predicted
    middle, weights = _biweight(ratio) if robust else (float(np.median(ratio)), np.ones(len(ratio)))
    counted = weights > 0
    spread = float(np.median(np.abs(ratio[counted] - middle)))
    outliers = f"; {1 - counted.mean():.0%} of them are outliers, which do not count" if robust else ""
    return MetricScale(
        float(np.exp(middle)),
        f"{len(ratio)} known depths, from which the scaled ones differ by {spread:.1%} (median){outliers}",
    )


def _biweight(values: Float64[np.ndarray, " N"]) -> tuple[float, Float64[np.ndarray, " N"]]:
    """Return the place around which most values lie, and the weight of each, 0 for outliers."""
    ordered = np.sort(values)
    half = len(values) // 2
    lengths = ordered[half:] - ordered[: len(values) - half]
    first = int(np.argmin(lengths))
    place = float(ordered[first] + lengths[first] / 2)
    reach = _TUKEY * max(lengths[first] / 2 / _QUARTILE, _LEAST_SPREAD)
    weights = np.ones(len(values))
    for _ in range(_ROUNDS):
        weights = np.maximum(1 - ((values - place) / reach) ** 2, 0) ** 2
        moved = float(np.average(values, weights=weights)) - place
        place += moved
        if abs(moved) < _SETTLED * reach:
            break
    return place, weights


def _reliable_pixels(result: Result) -> Bool[np.ndarray, "S H W"]:
    """Return pixels that show a static point whose confidence is not among the lowest fifth of the clip."""
    used = result.valid_pixels & ~result.dynamic_mask
    if not used.any():
        return used
    return used & (result.depth_confidence >= np.percentile(result.depth_confidence[used], 20))


def _through(points: Float64[np.ndarray, "3 3"], down: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 4"] | None:
    """Return normal and offset of the plane through three points, its normal down; None if it is far from level."""
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-12 or abs(normal @ down) < np.cos(np.radians(_TILT)) * length:
        return None
    normal *= np.sign(normal @ down) / length
    return np.append(normal, normal @ points[0])


def _below(plane: Float64[np.ndarray, " 4"], cameras: Float64[np.ndarray, "S 3"]) -> bool:
    return bool((cameras @ plane[:3] < plane[3]).all())


def _floor(
    points: Float64[np.ndarray, "N 3"], cameras: Float64[np.ndarray, "S 3"], down: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, " 4"] | None, float]:
    """Return the plane (normal, offset) below the cameras with the most points, and its share of them."""

    def near(plane: Float64[np.ndarray, " 4"]) -> Bool[np.ndarray, " N"]:
        height = plane[3] - cameras.mean(axis=0) @ plane[:3]
        return np.abs(points @ plane[:3] - plane[3]) < _THICK * height

    best, most = None, 0
    for corners in np.random.default_rng(0).choice(len(points), (_TRIES, 3)):
        plane = _through(points[corners], down)
        if plane is not None and _below(plane, cameras) and (count := int(near(plane).sum())) > most:
            best, most = plane, count
    for _ in range(_REFINEMENTS):
        if best is None:
            break
        chosen = points[near(best)]
        normal = np.linalg.svd(chosen - chosen.mean(axis=0), full_matrices=False)[2][2]
        normal *= np.sign(normal @ down)
        plane = np.append(normal, normal @ chosen.mean(axis=0))
        if not _below(plane, cameras) or (count := int(near(plane).sum())) < most:
            break
        best, most = plane, count
    return best, most / len(points)
