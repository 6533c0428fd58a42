"""One result as the data of the page: points with their colours, cameras, tracks and a sheet of small pictures."""

from __future__ import annotations

import base64
import io
import itertools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16
from PIL import Image

from vggtjax.cameras import frustum_corners
from vggtjax.errors import one_line
from vggtjax.progress import Progress
from vggtjax.results.colors import hues
from vggtjax.results.frame import frame_of
from vggtjax.results.gltf_animation import frame_rate
from vggtjax.results.result import Result
from vggtjax.results.shown import ShownPoints, middle_and_radius, relative_steps, shown_points
from vggtjax.results.tracks import SEEN
from vggtjax.results.viewer.colors import TIME_RAMP, confidence_ranks, lacks, offered_colors
from vggtjax.results.viewer.home import Place, home_view, median_depth, tangents
from vggtjax.results.widths import point_widths

LARGEST_STEP = 0.3  # of depth between neighbours, as a share; pixels beside larger ones are never shown
_LEAST_MOVING = 200  # points of a frame
FRUSTUM = 0.045  # of the scene's radius
_TILE, _SHEET = 256, 4096  # pixels: the longer side of a small picture; a side of the sheet that every browser takes


class Budget(NamedTuple):
    """The most points of a result in the page."""

    static: int = 160_000
    moving: int = 800_000  # of all frames together


def place_beside(result: Result, first: Result) -> Place:
    """Return the place at which the first camera is that of `first`, and the median depth of its frame the same."""
    scale = median_depth(first) / median_depth(result)
    ours, theirs = (one.camera_from_world[0].astype(np.float64) for one in (result, first))
    rotation = theirs[:, :3].T @ ours[:, :3]
    offset = theirs[:, :3].T @ (scale * ours[:, 3] - theirs[:, 3])
    return Place(scale, rotation, offset)


def scene_of(
    result: Result, name: str, place: Place, *, budget: Budget, progress: Progress | None = None
) -> dict[str, Any]:
    """Return what the page shows of a result: JSON values and arrays, by the names that client/*.js read."""
    S, H, W = result.depth.shape
    static, moving = shown_points(
        result,
        static_percentile=0,
        dynamic_percentile=0,
        edges=LARGEST_STEP,
        most_static=budget.static,
        most_moving=max(_LEAST_MOVING, budget.moving // S),
        progress=progress,
    )
    random = np.random.default_rng(0)
    orders = [random.permutation(len(part.pixels)) for part in (static, *moving)]  # the first of any number cover all
    parts = [
        ShownPoints(*(field[order] for field in part)) for part, order in zip((static, *moving), orders, strict=True)
    ]
    positions, frames, pixels = (np.concatenate(fields) for fields in zip(*parts, strict=True))
    points = ShownPoints(positions, frames, pixels)
    middle, radius = middle_and_radius(result)
    all_widths = _shown_widths(result, static, moving)
    widths = place.scale * np.concatenate([widths[order] for widths, order in zip(all_widths, orders, strict=True)])
    centre, radius = place.points(middle), radius * place.scale
    positions = place.points(points.positions)
    corners = frustum_corners(result.intrinsics, result.camera_from_world, H, W, 1)
    corners = place.points(corners[:, :1] + (corners - corners[:, :1]) * (FRUSTUM * radius / place.scale))
    coded, narrowest, doublings = _in_logarithms(widths)
    quality = [confidence_ranks(result, points), _steps(result, points), coded]
    return {
        "name": one_line(name, 80),
        "facts": _facts(result),
        "note": one_line(result.model_note),
        "frames": S,
        "rate": playing_rate(result),
        "times": None if result.timestamps is None else (result.timestamps - result.timestamps[0]).tolist(),
        "centre": centre.tolist(),
        "scale": radius,
        "positions": contracted(positions, centre, radius).ravel(),
        "quality": np.stack(quality, axis=-1).ravel(),
        "widths": [narrowest, doublings],
        "staticCount": len(static.pixels),
        "offsets": len(static.pixels) + np.cumsum([0, *(len(part.pixels) for part in moving)], dtype=np.uint32),
        "largestStep": LARGEST_STEP,
        "colors": offered_colors(result, points),
        "corners": corners.ravel(),
        "frustumSize": FRUSTUM * radius,
        "frameColors": TIME_RAMP[np.linspace(0, 230, S).round().astype(int)].ravel(),
        "tracks": _tracks(result, place),
        "home": home_view(result, place),
        **_cameras(result, place),
        **_sheet(result),
    }


def contracted(
    positions: Float32[np.ndarray, "N 3"], centre: Float32[np.ndarray, " 3"], scale: float
) -> UInt16[np.ndarray, "N 3"]:
    """Return d / (scale + |d|) of the offsets d from the centre in 16 bits: fine near the centre, coarse far away."""
    offsets = np.nan_to_num(positions).astype(np.float64) - centre
    inside = offsets / (scale + np.linalg.norm(offsets, axis=-1, keepdims=True))
    return ((inside + 1) * 32767.5).round().astype(np.uint16)


def _facts(result: Result) -> str:
    S, H, W = result.depth.shape
    frames = f"{S} frame{'s' if S > 1 else ''} of {W} x {H}"
    moving = f" · {result.dynamic_share:.0%} moving" if result.has_mask else ""
    return one_line(f"{result.method} · {result.model_name} · {frames}{moving}")


def playing_rate(result: Result) -> float:
    """Return frames a second, at least one in two seconds and at most 60."""
    return float(np.clip(frame_rate(result), 0.5, 60))


def _shown_widths(result: Result, static: ShownPoints, moving: list[ShownPoints]) -> list[Float32[np.ndarray, " N"]]:
    """Return the widths of the static points and of the moving ones of each frame, thinned as they are."""
    is_moving = result.valid_pixels & result.dynamic_mask
    pixels = [np.count_nonzero(result.valid_pixels & ~result.dynamic_mask), *np.count_nonzero(is_moving, axis=(1, 2))]
    parts = zip((static, *moving), pixels, strict=True)
    return [point_widths(result, part, thinning=count / max(len(part.pixels), 1)) for part, count in parts]


def _in_logarithms(widths: Float[np.ndarray, " N"]) -> tuple[UInt8[np.ndarray, " N"], float, float]:
    """Return numbers v of positive widths, and (a, b) of width = a * 2 ** (b * v / 255)."""
    if widths.size == 0:
        return np.zeros(0, np.uint8), 1.0, 0.0
    logarithms = np.log2(np.clip(np.nan_to_num(widths), 1e-30, 1e30).astype(np.float64))
    low, high = float(logarithms.min()), float(logarithms.max())
    shares = (logarithms - low) / max(high - low, 1e-9)
    return (255 * shares).round().astype(np.uint8), 2.0**low, high - low


def _steps(result: Result, points: ShownPoints) -> UInt8[np.ndarray, " N"]:
    """Return the largest relative step of depth to a neighbour, 255 for `LARGEST_STEP`; 0 on steep surfaces."""
    steps = np.zeros(len(points.pixels), np.uint8)
    order = np.argsort(points.frames, kind="stable")
    bounds = np.searchsorted(points.frames[order], np.arange(len(result.depth) + 1))
    for number, (first, end) in enumerate(itertools.pairwise(bounds.tolist())):
        chosen = order[first:end]
        of_points = relative_steps(frame_of(result, number)).ravel()[points.pixels[chosen]]
        steps[chosen] = (np.clip(of_points / LARGEST_STEP, 0, 1) * 255).round().astype(np.uint8)
    return steps


def _cameras(result: Result, place: Place) -> dict[str, Any]:
    """Return world-from-camera in the page's world, and the tangents of half the fields of view."""
    poses = np.concatenate(
        [place.rotation @ result.world_from_camera[:, :3, :3], place.points(result.camera_centres)[..., None]], axis=-1
    )
    return {"poses": poses.astype(np.float32).ravel(), "tangents": tangents(result).astype(np.float32).ravel()}


def _tracks(result: Result, place: Place) -> dict[str, Any] | None:
    """Return the points of the tracks in the world, NaN where hidden or without depth, and a colour for each track."""
    if result.track_positions is None or result.track_visibility is None or result.track_positions.size == 0:
        return None
    S, H, W = result.depth.shape
    count = result.track_positions.shape[1]
    columns, rows = (np.floor(result.track_positions[..., i]).astype(np.int64) for i in range(2))
    inside = (columns >= 0) & (columns < W) & (rows >= 0) & (rows < H) & (result.track_visibility >= SEEN)
    columns, rows = columns.clip(0, W - 1), rows.clip(0, H - 1)
    positions = np.full((S, count, 3), np.nan, np.float32)
    for number in range(S):
        frame = frame_of(result, number)
        known = inside[number] & frame.valid[rows[number], columns[number]]
        positions[number, known] = place.points(frame.world_points()[rows[number], columns[number]][known])
    return {"positions": positions.ravel(), "colors": hues(count).ravel()}


def _sheet(result: Result) -> dict[str, Any]:
    """Return the pictures of all frames, made small, in one JPEG as a data URL, row by row."""
    S, H, W = result.depth.shape
    scale = min(1.0, _TILE / max(H, W))
    while True:
        width, height = max(1, round(W * scale)), max(1, round(H * scale))
        columns = max(1, min(S, _SHEET // width))
        rows = -(-S // columns)
        if rows * height <= _SHEET or max(width, height) <= 4:
            break
        scale *= 0.9
    sheet = Image.new("RGB", (columns * width, rows * height))
    for frame in range(S):
        small = Image.fromarray(result.images[frame]).resize((width, height), Image.Resampling.LANCZOS)
        sheet.paste(small, (frame % columns * width, frame // columns * height))
    file = io.BytesIO()
    sheet.save(file, "JPEG", quality=82)
    url = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
    return {
        "sheet": url,
        "columns": columns,
        "rows": rows,
        "tile": [width, height],
        "hasPictures": not lacks(result, "images"),
    }
