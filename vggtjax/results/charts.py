"""Charts of a result for its report: the path of the cameras from above and from the side, and how confidence spreads.

Both are the numbers that the template draws as SVG: matplotlib is an extra, which reports do without.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from vggtjax.cameras import camera_centres, frustum_corners
from vggtjax.results.frame import frame_of
from vggtjax.results.result import Result

# From the first frame to the last; all of them can be seen on white and on black.
PATH_COLORS = np.array([(47, 126, 247), (160, 75, 216), (240, 84, 45)])
WIDTH, HEIGHT = 560, 340  # of a chart
_EDGE = 18  # the empty border of a view
_FRUSTA = 40  # most cameras that are drawn
_PATH_STEPS = 400  # most segments of the path
_POINTS = 2400  # most points of the scene that are drawn
_CAMERA_SHARE = 0.15  # of the extent of the scene; smaller paths are drawn without the scene around them
_BINS = 48
_MOST_SAMPLES = 2_000_000  # pixels of the histogram
# Title, names of the axes, and what takes x right, y down, z forward to right and up in the chart.
_VIEWS = (
    ("From above", ("right", "forward"), np.array([(1, 0), (0, 0), (0, 1)])),
    ("From the side", ("forward", "up"), np.array([(0, 0), (0, -1), (1, 0)])),
)


def path_color(share: float) -> str:
    """Return the colour of a time, 0 for the first frame and 1 for the last."""
    stops = np.linspace(0, 1, len(PATH_COLORS))
    return "#{:02x}{:02x}{:02x}".format(*(round(float(np.interp(share, stops, part))) for part in PATH_COLORS.T))


def camera_views(result: Result) -> list[dict[str, Any]]:
    """Return the cameras from above and from the side, to one scale: the parts of each view.

    Directions are those of the first camera. Static points of the scene are drawn faintly where they lie in the view.
    """
    frames, height, width = result.depth.shape
    points = _scene_points(result)
    poses = result.camera_from_world.astype(np.float64)  # squares of far places are finite
    rotation, centre = poses[0, :, :3], camera_centres(poses)[0]
    centres = (camera_centres(poses) - centre) @ rotation.T
    points = (points - centre) @ rotation.T
    middle = np.median(centres, axis=0)
    near = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 1.0
    size = max(0.12 * float(np.ptp(centres, axis=0).max()), 0.05 * near, 1e-9)
    shown = np.linspace(0, frames - 1, min(frames, _FRUSTA)).round().astype(int)
    corners = frustum_corners(result.intrinsics[shown], poses[shown], height, width, size)
    corners = (corners - centre) @ rotation.T
    cameras = np.concatenate([corners.reshape(-1, 3), centres])
    seen = np.percentile(points, (3, 97), axis=0) if len(points) else cameras[:0]
    whole = np.concatenate([cameras, seen])
    small = np.ptp(cameras, axis=0).max() < _CAMERA_SHARE * np.ptp(whole, axis=0).max()
    extent = cameras if small else whole
    inner = np.array([WIDTH - 2 * _EDGE, HEIGHT - 2 * _EDGE])
    scale = min(float((inner / np.maximum(np.ptp(extent @ axes, axis=0), 1e-9)).min()) for _, _, axes in _VIEWS)
    length = _round_length(0.22 * WIDTH / scale)
    way = centres[np.linspace(0, frames - 1, min(frames, _PATH_STEPS + 1)).round().astype(int)]
    views = []
    for title, names, axes in _VIEWS:
        low, high = (extent @ axes).min(0), (extent @ axes).max(0)

        def place(world: Float[np.ndarray, "*N 3"], axes=axes, middle=(low + high) / 2) -> Float[np.ndarray, "*N 2"]:
            return (world @ axes - middle) * scale * [1, -1] + [WIDTH / 2, HEIGHT / 2]

        dots = place(points)
        dots = dots[((dots > 2) & (dots < [WIDTH - 2, HEIGHT - 2])).all(axis=1)]
        steps = [(*start, *end) for start, end in pairwise(place(way))]
        views.append(
            {
                "title": title,
                "names": names,
                "dots": "".join(f"M{x:.0f} {y:.0f}h0" for x, y in dots),
                "frusta": [
                    (_frustum(flat), path_color(number / max(frames - 1, 1)))
                    for number, flat in zip(shown.tolist(), place(corners), strict=True)
                ],
                "way": [
                    ("M{:.1f} {:.1f}L{:.1f} {:.1f}".format(*step), path_color((number + 0.5) / len(steps)))
                    for number, step in enumerate(steps)
                ],
                "first": [f"{value:.1f}" for value in place(way[0])],
                "length": f"{length:g}",
                "bar": f"{WIDTH - 14 - length * scale:.1f}",
            }
        )
    return views


def _frustum(corners: Float[np.ndarray, "5 2"]) -> str:
    apex, *ends = (f"{x:.1f} {y:.1f}" for x, y in corners)
    return "".join(f"M{apex}L{end}" for end in ends) + f"M{'L'.join(ends)}Z"


def _scene_points(result: Result) -> Float[np.ndarray, "N 3"]:
    """Return some static points of the world, of the more confident half of the pixels of up to eight frames."""
    frames = np.unique(np.linspace(0, len(result.depth) - 1, min(len(result.depth), 8)).round().astype(int))
    step = max(1, int(np.sqrt(result.depth[0].size * len(frames) / (8 * _POINTS))))
    found = []
    for number in frames:
        frame = frame_of(result, int(number))
        pixels = np.zeros(frame.depth.shape, bool)
        pixels[step // 2 :: step, step // 2 :: step] = True
        pixels &= frame.valid & ~frame.dynamic_mask
        if pixels.any():
            pixels &= frame.confidence >= np.median(frame.confidence[pixels].astype(np.float64))
        found.append(frame.world_points()[pixels])
    points = np.concatenate(found).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, -(-len(points) // _POINTS))]


def _round_length(length: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))


def confidence_histogram(result: Result) -> dict[str, Any]:
    """Return how the logarithm of confidence is spread over static and over moving pixels, each with area 1."""
    regions = {name: part for name, part in _log_confidence(result).items() if len(part)}
    values = np.concatenate([*regions.values(), np.zeros(0)])
    low, high = (float(np.quantile(values, q)) for q in (0.001, 0.999)) if len(values) else (0.0, 1.0)
    if high - low < 1e-6:
        low, high = low - 0.5, high + 0.5
    left, top, bottom = 14, 12, HEIGHT - 34
    width = WIDTH - 2 * left
    shares = {
        name: np.histogram(part.clip(low, high), _BINS, (low, high))[0] / len(part) for name, part in regions.items()
    }
    highest = max((float(share.max()) for share in shares.values()), default=1.0)
    outlines = {}
    ends = left + np.arange(1, _BINS + 1) * width / _BINS
    for name, share in shares.items():
        steps = "".join(
            f"V{y:.1f}H{x:.1f}" for x, y in zip(ends, bottom - share / highest * (bottom - top), strict=True)
        )
        outlines[name] = f"M{left} {bottom}{steps}V{bottom}Z"
    ticks = zip(np.linspace(left, left + width, 6), np.exp(np.linspace(low, high, 6)), strict=True)
    return {
        "outlines": outlines,
        "base": f"M{left} {bottom}H{left + width}",
        "ticks": [(f"{x:.1f}", f"{value:.3g}") for x, value in ticks],
        "ticks_y": bottom + 18,
    }


def _log_confidence(result: Result) -> dict[str, Float[np.ndarray, " N"]]:
    """Return the logarithm of the confidence of static and of moving pixels, of evenly spread pixels."""
    step = max(1, -(-result.depth.size // _MOST_SAMPLES))
    confidence, moving = result.depth_confidence.reshape(-1)[::step], result.dynamic_mask.reshape(-1)[::step]
    valid = result.valid_pixels.reshape(-1)[::step] & (confidence > 0)
    return {
        "static": np.log(confidence[valid & ~moving], dtype=np.float64),
        "moving": np.log(confidence[valid & moving], dtype=np.float64),
    }
