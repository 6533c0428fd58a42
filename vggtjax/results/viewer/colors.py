"""What the points can be coloured by: a table of which every result offers the rows that it has data for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vggtjax.options import METHODS
from vggtjax.results.colors import color_ramp
from vggtjax.results.previews import (
    CONFIDENCE_COLORS,
    DEPTH_COLORS,
    INSTANCE_COLORS,
    MOST_MOTION,
    SALIENCY_COLORS,
    inverse_depth_range,
    moving_ids,
)
from vggtjax.results.result import Result, missing_fields
from vggtjax.results.shown import ShownPoints

_MOST_NAMES = 8  # of objects in a legend
_SAMPLE = 1 << 20  # values of a clip that a range is taken from
_GREY = (110, 110, 120)
_STATIC, _MOVING = 0, 1
_FIRST, _SECOND, _BOTH = 0, 1, 2


class ColorMode(NamedTuple):
    """One row of the table: numbers 0 to 255 of points, and what they stand for."""

    name: str
    offers: Callable[[Result], bool]
    values: Callable[[Result, ShownPoints], UInt8[np.ndarray, " N"]]
    ramp: UInt8[np.ndarray, "256 3"]
    legend: Callable[[Result], dict[str, Any]]  # low and high, or the names of single values


def offered_colors(result: Result, points: ShownPoints) -> list[dict[str, Any]]:
    """Return what the page needs of every colouring that the result has: name, values, ramp and legend."""
    colors = [
        {"name": mode.name, "values": mode.values(result, points), "ramp": mode.ramp.ravel(), **mode.legend(result)}
        for mode in _MODES
        if mode.offers(result)
    ]
    if lacks(result, "images"):
        return colors
    return [{"name": "picture", "values": points.values(result.images).ravel()}, *colors]


def lacks(result: Result, field: str) -> bool:
    """Return whether plain values stand for a field that another program did not write."""
    return field in missing_fields(result)


def confidence_ranks(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    """Return how many of 255 equal shares of the confidences of a point's region, static or moving, it reaches."""
    ranks = np.full(len(points.pixels), 255, np.uint8)
    valid, confidence = result.valid_pixels, points.values(result.depth_confidence)
    moving = points.values(result.dynamic_mask)
    for region, chosen in ((valid & ~result.dynamic_mask, ~moving), (valid & result.dynamic_mask, moving)):
        if chosen.any():
            levels = np.quantile(_sample(result.depth_confidence, region), np.arange(1, 256) / 256)
            ranks[chosen] = np.searchsorted(levels, confidence[chosen], side="right")
    return ranks


def _sample(array: Float[np.ndarray, "S H W"], pixels: Bool[np.ndarray, "S H W"]) -> np.ndarray:
    values = array[pixels]
    return values[:: max(1, values.size // _SAMPLE)]


def _levels(values: np.ndarray, low: float, high: float) -> UInt8[np.ndarray, " N"]:
    share = (values.astype(np.float64) - low) / max(high - low, np.finfo(np.float64).tiny)
    return (np.clip(np.nan_to_num(share), 0, 1) * 255).round().astype(np.uint8)


def _depth(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    return _levels(1 / points.values(result.depth), *inverse_depth_range(result.depth, result.valid_pixels))


def _precision_range(result: Result) -> tuple[float, float]:
    low, high = np.percentile(_sample(result.depth_confidence, result.valid_pixels), (2, 98))
    tiny = float(np.finfo(np.float32).tiny)
    return max(float(low), tiny), max(float(high), tiny)


def _precision(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    low, high = np.log(_precision_range(result))
    values = np.maximum(points.values(result.depth_confidence), np.finfo(np.float32).tiny)
    return _levels(np.log(values), low, high)


def _of_patches(values: Float[np.ndarray, "S h w"], points: ShownPoints, H: int, W: int) -> Float[np.ndarray, " N"]:
    _, h, w = values.shape
    rows, columns = np.divmod(points.pixels, W)
    return values[points.frames, rows * h // H, columns * w // W]


def _saliency(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    assert result.saliency is not None
    return _levels(_of_patches(result.saliency, points, *result.depth.shape[1:]), 0, 1)


def _motion(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    assert result.motion is not None
    return _levels(_of_patches(result.motion, points, *result.depth.shape[1:]), 1, MOST_MOTION)


def _object_names(result: Result) -> dict[str, Any]:
    objects = range(1, min(int(result.instances.max()), _MOST_NAMES) + 1)
    return {"names": [(0, "static"), *((number, f"object {number}") for number in objects)]}


def _pass(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    return np.where(points.values(result.dynamic_mask), _FIRST, _still_pass(result)).astype(np.uint8)


def _still_pass(result: Result) -> int:
    """Return which pass gave the depth of static pixels."""
    return _BOTH if METHODS[result.method].depth == "fused" else _SECOND


def _pass_names(result: Result) -> dict[str, Any]:
    still = _still_pass(result)
    return {"names": [(_FIRST, "first pass"), (still, "both, fused" if still == _BOTH else "second pass")]}


def _time(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    return _levels(points.frames, 0, max(len(result.depth) - 1, 1))


def _palette(*colors: tuple[int, int, int]) -> UInt8[np.ndarray, "256 3"]:
    palette = np.tile(np.array(_GREY, np.uint8), (256, 1))
    palette[: len(colors)] = colors
    return palette


def _ends(low: str, high: str) -> Callable[[Result], dict[str, Any]]:
    return lambda _: {"low": low, "high": high}


TIME_RAMP = color_ramp("plasma")
_MODES = (
    ColorMode("depth", lambda _: True, _depth, DEPTH_COLORS, _ends("far", "near")),
    ColorMode(
        "confidence",
        lambda result: not lacks(result, "depth_confidence"),
        confidence_ranks,
        CONFIDENCE_COLORS,
        _ends("lowest", "highest"),
    ),
    ColorMode(
        "fused precision",
        lambda result: bool(result.settings.get("fusion")) and bool(result.valid_pixels.any()),
        _precision,
        color_ramp("cividis"),
        lambda result: dict(zip(("low", "high"), (f"{end:.3g}" for end in _precision_range(result)), strict=True)),
    ),
    ColorMode(
        "mask",
        lambda result: result.has_mask,
        lambda result, points: points.values(result.dynamic_mask).astype(np.uint8),
        _palette(_GREY, (255, 90, 130)),
        lambda _: {"names": [(_STATIC, "static"), (_MOVING, "moving")]},
    ),
    ColorMode(
        "object",
        lambda result: result.has_mask and bool(result.instances.any()),
        lambda result, points: moving_ids(points.values(result.dynamic_mask), points.values(result.instances)),
        np.concatenate([np.array([_GREY], np.uint8), INSTANCE_COLORS[1:]]),
        _object_names,
    ),
    ColorMode("saliency", lambda result: result.saliency is not None, _saliency, SALIENCY_COLORS, _ends("0", "1")),
    ColorMode(
        "motion",
        lambda result: result.motion is not None,
        _motion,
        SALIENCY_COLORS,
        _ends("as the median patch", f"{MOST_MOTION} times it"),
    ),
    ColorMode(
        "pass",
        lambda result: result.method in METHODS and METHODS[result.method].depth in ("replaced", "fused"),
        _pass,
        _palette((255, 170, 60), (80, 150, 255), (90, 210, 160)),
        _pass_names,
    ),
    ColorMode("time", lambda result: len(result.depth) > 1, _time, TIME_RAMP, _ends("first frame", "last frame")),
)
