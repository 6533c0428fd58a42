"""Charts of a result as SVG: the path of the cameras from above and from the side, and a histogram of confidence."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from vggtjax.cameras import camera_centres, frustum_corners
from vggtjax.results.frame import frame_of
from vggtjax.results.result import Result
from vggtjax.storage.markup import element

# From the first frame to the last; all of them can be seen on white and on black.
PATH_COLORS = np.array([(47, 126, 247), (160, 75, 216), (240, 84, 45)])
_WIDTH, _HEIGHT, _EDGE = 560, 340, 18  # of a view, and its empty border
_FRUSTA = 40  # most cameras that are drawn
_PATH_STEPS = 400  # most segments of the path
_POINTS = 2400  # most points of the scene that are drawn
_CAMERA_SHARE = 0.15  # of the extent of the scene; smaller paths are drawn without the scene around them
_BINS = 48
_MOST_SAMPLES = 2_000_000  # pixels of the histogram


class _View(NamedTuple):
    """A direction to look from; points are in the axes of the first camera."""

    title: str
    axes: tuple[int, int]  # drawn to the right and upwards
    signs: tuple[int, int]
    names: tuple[str, str]

    def flat(self, points: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 2"]:
        return points[..., list(self.axes)] * self.signs


_VIEWS = (
    _View("From above", (0, 2), (1, 1), ("right", "forward")),
    _View("From the side", (2, 1), (1, -1), ("forward", "up")),
)


def path_color(share: float) -> str:
    """Return the colour of a time, 0 for the first frame and 1 for the last."""
    place = np.interp(share, np.linspace(0, 1, len(PATH_COLORS)), np.arange(len(PATH_COLORS)))
    low = min(int(place), len(PATH_COLORS) - 2)
    mixed = PATH_COLORS[low] + (place - low) * (PATH_COLORS[low + 1] - PATH_COLORS[low])
    return "#{:02x}{:02x}{:02x}".format(*mixed.round().astype(int))


def camera_views(result: Result) -> list[tuple[str, Element]]:
    """Draw the cameras from above and from the side, to one scale: name and picture of each view.

    Directions are those of the first camera. Static points of the scene are drawn faintly where they lie in the view.
    """
    frames, height, width = result.depth.shape
    points = _scene_points(result)
    poses = result.camera_from_world.astype(np.float64)  # squares of far places are finite
    world_centres = camera_centres(poses)
    rotation, centre = poses[0, :, :3], world_centres[0]
    centres = (world_centres - centre) @ rotation.T
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
    boxes = [(flat.min(0), flat.max(0)) for flat in (view.flat(cameras if small else whole) for view in _VIEWS)]
    inner = np.array([_WIDTH - 2 * _EDGE, _HEIGHT - 2 * _EDGE])
    scale = min(float((inner / np.maximum(high - low, 1e-9)).min()) for low, high in boxes)
    return [
        (view.title, _draw_view(view, (low + high) / 2, scale, points, centres, (shown / max(frames - 1, 1), corners)))
        for view, (low, high) in zip(_VIEWS, boxes, strict=True)
    ]


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


def _draw_view(
    view: _View,
    middle: Float[np.ndarray, " 2"],
    scale: float,
    points: Float[np.ndarray, "N 3"],
    centres: Float[np.ndarray, "S 3"],
    frusta: tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F 5 3"]],
) -> Element:
    """Draw one view; `frusta` are shares of the clip's time, and the corners of the cameras then."""

    def place(world: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 2"]:
        return (view.flat(world) - middle) * scale * [1, -1] + [_WIDTH / 2, _HEIGHT / 2]

    drawing = element(
        "svg", viewBox=f"0 0 {_WIDTH} {_HEIGHT}", role="img", aria_label=f"{view.title}: path of the cameras"
    )
    dots = place(points)
    dots = dots[((dots > 2) & (dots < [_WIDTH - 2, _HEIGHT - 2])).all(axis=1)]
    drawing.append(_line("".join(f"M{x:.0f} {y:.0f}h0" for x, y in dots), width=2, stroke_opacity=0.28))
    for share, corners in zip(frusta[0], place(frusta[1]), strict=True):
        apex, *ends = (f"{x:.1f} {y:.1f}" for x, y in corners)
        sides = "".join(f"M{apex}L{end}" for end in ends)
        color = path_color(float(share))
        drawing.append(_line(f"{sides}M{'L'.join(ends)}Z", color, 1.3, fill=color, fill_opacity=0.12))
    way = place(centres[np.linspace(0, len(centres) - 1, min(len(centres), _PATH_STEPS + 1)).round().astype(int)])
    for step, (start, end) in enumerate(pairwise(way)):
        line = "M{:.1f} {:.1f}L{:.1f} {:.1f}".format(*start, *end)
        drawing.append(_line(line, path_color((step + 0.5) / (len(way) - 1)), 2.6))
    x, y = way[0]
    first = {"cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": 4.5, "fill": path_color(0)}
    drawing.append(element("circle", element("title", "first frame"), **first))
    _draw_scale(drawing, view, scale)
    return drawing


def _line(d: str, color: str = "currentColor", width: float = 1.2, **attributes: object) -> Element:
    shape = {"fill": "none", "stroke_linejoin": "round", "stroke_linecap": "round"}
    return element("path", d=d, stroke=color, stroke_width=width, **(shape | attributes))


def _draw_scale(drawing: Element, view: _View, scale: float) -> None:
    """Draw a bar of a round length, and what the axes are."""
    length = _round_length(0.22 * _WIDTH / scale)
    x, y = _WIDTH - 14, _HEIGHT - 14
    bar = f"M{x - length * scale:.1f} {y - 4}v4H{x}v-4"
    drawing.append(_line(bar))
    drawing.append(element("text", f"{length:g}", x=x, y=y - 8, text_anchor="end"))
    right, up = view.names
    drawing.append(_line(f"M14 {y - 34}V{y}H48"))
    drawing.append(element("text", right, x=53, y=y + 4))
    drawing.append(element("text", up, x=12, y=y - 41))


def _round_length(length: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))


def confidence_histogram(result: Result) -> Element:
    """Draw how the logarithm of confidence is spread over static and over moving pixels, each with area 1."""
    regions = _log_confidence(result)
    values = np.concatenate(list(regions.values()))
    low, high = (float(np.quantile(values, q)) for q in (0.001, 0.999)) if len(values) else (0.0, 1.0)
    if high - low < 1e-6:
        low, high = low - 0.5, high + 0.5
    left, top, bottom = 14, 12, _HEIGHT - 34
    width = _WIDTH - 2 * left
    drawing = element(
        "svg", viewBox=f"0 0 {_WIDTH} {_HEIGHT}", role="img", aria_label="Histogram of the logarithm of confidence"
    )
    heights = {
        name: np.histogram(part.clip(low, high), _BINS, (low, high))[0] / len(part)
        for name, part in regions.items()
        if len(part)
    }
    highest = max((float(shares.max()) for shares in heights.values()), default=1.0)
    for name, shares in heights.items():
        steps = [f"M{left} {bottom}"]
        for number, share in enumerate(shares):
            steps.append(f"V{bottom - share / highest * (bottom - top):.1f}H{left + (number + 1) * width / _BINS:.1f}")
        drawing.append(
            _line("".join(steps) + f"V{bottom}Z", color := f"var(--{name})", 1.6, fill=color, fill_opacity=0.2)
        )
    base = f"M{left} {bottom}H{_WIDTH - left}"
    drawing.append(_line(base, stroke_opacity=0.5))
    ticks = np.linspace(low, high, 6)
    for number, tick in enumerate(ticks):
        anchor = "start" if number == 0 else "end" if number == len(ticks) - 1 else "middle"
        x = left + number * width / (len(ticks) - 1)
        drawing.append(element("text", f"{np.exp(tick):.3g}", x=f"{x:.1f}", y=bottom + 18, text_anchor=anchor))
    return drawing


def _log_confidence(result: Result) -> dict[str, Float[np.ndarray, " N"]]:
    """Return the logarithm of the confidence of static and of moving pixels, of evenly spread pixels."""
    step = max(1, -(-result.depth.size // _MOST_SAMPLES))
    confidence, moving = result.depth_confidence.reshape(-1)[::step], result.dynamic_mask.reshape(-1)[::step]
    valid = result.valid_pixels.reshape(-1)[::step] & (confidence > 0)
    return {
        "static": np.log(confidence[valid & ~moving], dtype=np.float64),
        "moving": np.log(confidence[valid & moving], dtype=np.float64),
    }
