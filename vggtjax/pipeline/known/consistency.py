"""Depth and focal length that known poses and the pictures agree on: choices from the costs of a sweep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Float64

from vggtjax.cameras import zoomed
from vggtjax.pipeline.known.sweep import Views, sweep_costs
from vggtjax.results.result import Result

_SIDE = 128  # longest side in pixels that is swept at; the scale and the focal length at half of it
_WIDE = np.linspace(-1.6, 1.6, 17)  # logarithms of factors, for one scale of the clip
_NARROW = np.linspace(-1.2, 1.2, 17)  # for each pixel
_FEW = np.linspace(-1.2, 1.2, 9)  # for each focal length
_FOCALS = np.array([-0.4, -0.25, -0.12, 0.0, 0.12, 0.25, 0.4])  # logarithms of factors
_OTHERS = 5  # frames that a frame is compared with
_PRIOR = 0.05  # cost of a factor e; the prediction is doubted less the farther a factor is from 1
_SCALE_PRIOR = 0.01
_SPREAD = 0.09  # of the longest side: standard deviation of the region that is taken to share a factor
_LEAST_GAIN = 0.03  # of the correlation; regions that gain less keep their depth
_LEAST_SCALE_GAIN = 0.01  # of the mean correlation
_LEAST_FOCAL_GAIN = 0.005  # share of the cost


class Consistent(NamedTuple):
    """Corrections of a prediction that has known poses."""

    focal: float  # factor of the focal lengths
    depth: Float64[np.ndarray, "S H W"]  # factor of the depth
    cost: tuple[float, float]  # mean of 1 - correlation of the static pixels: of the prediction, and corrected


def consistent_with_poses(result: Result, *, focal_known: bool) -> Consistent:
    """Return factors of focal length and depth under which the frames look alike from the result's poses.

    First one factor for the depth of the clip; then, unless it is known, a factor of the focal lengths; then a factor
    for every pixel, which its neighbourhood shares. What gains little stays as it was predicted. Moving pixels take the
    factor of the static ones around them.
    """
    height, width = result.depth.shape[1:]
    step = -(-max(height, width) // _SIDE)
    views = _pooled(result, step)
    small = _pooled(result, 2 * step)
    before = _mean(_regional(views, np.zeros(1))[:, 0], views.usable)
    scale = _one_scale(small)
    focal = 1.0 if focal_known else _focal(small._replace(depth=small.depth * scale))
    views = views._replace(depth=views.depth * scale, intrinsics=zoomed(views.intrinsics, focal))
    logarithms, after = _fields(views)
    enlarged = np.stack([_enlarged(field, step, (height, width)) for field in logarithms])
    return Consistent(focal, scale * np.exp(enlarged), (before, after))


def _one_scale(views: Views) -> float:
    """Return the factor of all depths with the least mean cost."""
    costs = sweep_costs(views, np.exp(_WIDE), _OTHERS)
    mean = (costs * views.usable[:, None]).sum(axis=(0, 2, 3)) / max(int(views.usable.sum()), 1)
    mean += _SCALE_PRIOR * _WIDE**2
    if mean[len(_WIDE) // 2] - mean.min() <= _LEAST_SCALE_GAIN:
        return 1.0
    return float(np.exp(_lowest(mean[None, :, None, None], _WIDE)[0, 0, 0]))


def _focal(views: Views) -> float:
    """Return the factor of the focal lengths with the least cost at the best factor of every region's depth."""
    costs = []
    for logarithm in _FOCALS:
        changed = views._replace(intrinsics=zoomed(views.intrinsics, float(np.exp(logarithm))))
        costs.append(_mean(_regional(changed, _FEW).min(axis=1), views.usable))
    best = int(np.argmin(costs))
    if costs[best] > (1 - _LEAST_FOCAL_GAIN) * costs[len(_FOCALS) // 2]:
        return 1.0
    near = np.clip(best, 1, len(_FOCALS) - 2) + np.arange(-1, 2)
    curve, slope, _ = np.polyfit(_FOCALS[near], np.array(costs)[near], 2)
    place = -slope / (2 * curve) if curve > 0 else _FOCALS[best]
    return float(np.exp(np.clip(place, _FOCALS[near[0]], _FOCALS[near[2]])))


def _fields(views: Views) -> tuple[Float[np.ndarray, "S H W"], float]:
    """Return logarithms of factors for every pixel, and the mean cost at the best of them."""
    costs = _regional(views, _NARROW)
    middle = costs[:, len(_NARROW) // 2]
    gains = middle - costs.min(axis=1) > _LEAST_GAIN
    fields = np.where(gains, _lowest(costs, _NARROW), 0)
    sigma = _SPREAD * max(middle.shape[1:]) / 2
    fields = np.stack([scipy.ndimage.gaussian_filter(field, sigma) for field in fields])
    after = np.where(gains, costs.min(axis=1), middle)
    return fields, _mean(after, views.usable)


def _regional(views: Views, logarithms: Float[np.ndarray, " F"]) -> Float[np.ndarray, "S F H W"]:
    """Return costs averaged over the static pixels around every pixel, with the prior."""
    costs = sweep_costs(views, np.exp(logarithms), _OTHERS)
    sigma = _SPREAD * max(costs.shape[2:])
    for cost, usable in zip(costs, views.usable.astype(np.float32), strict=True):
        cost[:] = scipy.ndimage.gaussian_filter(cost * usable, (0, sigma, sigma)) / (
            scipy.ndimage.gaussian_filter(usable, sigma) + 1e-6
        )
    return costs + _PRIOR * (logarithms**2)[:, None, None]


def _lowest(costs: Float[np.ndarray, "S F H W"], logarithms: Float[np.ndarray, " F"]) -> Float[np.ndarray, "S H W"]:
    """Return where the parabola through the least cost and its neighbours is lowest."""
    best = np.clip(costs.argmin(axis=1), 1, len(logarithms) - 2)
    below, at, above = (np.take_along_axis(costs, (best + k)[:, None], axis=1)[:, 0] for k in (-1, 0, 1))
    curve = np.maximum(below - 2 * at + above, 1e-9)
    return logarithms[best] + np.clip((below - above) / (2 * curve), -1, 1) * (logarithms[1] - logarithms[0])


def _mean(values: Float[np.ndarray, "S H W"], usable: Bool[np.ndarray, "S H W"]) -> float:
    return float(values[usable].mean()) if usable.any() else 0.0


def _pooled(result: Result, step: int) -> Views:
    """Return grey frames with step x step pixels in one; rows and columns beyond a multiple are left out."""
    rows, columns = (side // step for side in result.depth.shape[1:])

    def blocks(array: np.ndarray) -> np.ndarray:
        cut = array[:, : rows * step, : columns * step]
        return cut.reshape(len(cut), rows, step, columns, step)

    usable = np.asarray(blocks(result.valid_pixels & ~result.dynamic_mask).all(axis=(2, 4)))
    depth = np.where(result.valid_pixels, result.depth, 0)
    intrinsics = result.intrinsics.astype(np.float64)
    intrinsics[:, :2] /= step
    return Views(
        blocks(result.images.mean(axis=-1) / 255).mean(axis=(2, 4)),
        np.median(blocks(depth), axis=(2, 4)),
        intrinsics,
        result.camera_from_world.astype(np.float64),
        usable,
    )


def _enlarged(field: Float[np.ndarray, "h w"], step: int, size: tuple[int, int]) -> Float[np.ndarray, "H W"]:
    """Return a field at the pixels of the result, linear between the middles of the pooled ones."""
    large = np.asarray(field if step == 1 else scipy.ndimage.zoom(field, step, order=1, mode="nearest", grid_mode=True))
    return np.pad(large, [(0, size[0] - large.shape[0]), (0, size[1] - large.shape[1])], mode="edge")
