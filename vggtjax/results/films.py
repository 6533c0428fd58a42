"""Films of a result: its static points stay, the moving points of the due frame play, seen by a virtual camera."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from vggtjax.cameras import FRUSTUM_EDGES, Cameras, frustum_corners, project
from vggtjax.errors import InputError, check_choice, whole_number
from vggtjax.progress import Progress, no_progress
from vggtjax.results.frame import PLAIN_RATE
from vggtjax.results.rendering.film import write_film as write_film
from vggtjax.results.rendering.paths import fitted_intrinsics, follow, middle_camera, orbit
from vggtjax.results.rendering.splats import BACKGROUND, Splats, draw_splats
from vggtjax.results.result import Result
from vggtjax.results.shown import ShownPoints, shown_points
from vggtjax.results.widths import point_widths

Path = Literal["orbit", "camera"]
MOST_SIDE, MOST_FRAMES = 4096, 10_000
_PATHS = {"orbit": orbit, "camera": follow}
_WIDE = 6.0  # pixels; discs that are wider take long to draw, and are coarser than any edge: they are not supersampled
_LEFT_OUT = 10.0  # percent of the pixels, the least confident: holes look worse than unsure points
_MIDDLE = 40  # percentile of the depths that is the scene's middle: objects are nearer than walls
_NEAR = 0.1  # of the middle's depth; nearer points are not drawn
_CAMERA_SIZE = 0.07  # of the middle's depth
_EDGE_POINTS = 160  # of a line
_MOST_CAMERAS = 12  # drawn beside the due one
_LINE, _DUE_LINE = 0.35, 0.9  # width in pixels at the middle's depth; the cameras are nearer
_FAINT, _DUE = (110, 116, 135), (255, 190, 40)  # the cameras; the due one


def film_frames(
    result: Result,
    *,
    path: Path = "orbit",
    seconds: float = 6.0,
    fps: float = 24.0,
    size: tuple[int, int] = (960, 540),
    background: tuple[int, int, int] = BACKGROUND,
    cameras: bool = True,
    progress: Progress | None = None,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Check the arguments, and return an iterator that draws the frames of a film, one at a time.

    On the orbit the clip is played as often as it fits, at least once, and the film can repeat without a jump; the film
    along the camera plays it once.

    Args:
        result: of a clip.
        path: "orbit" swings around the scene, "camera" follows the filming camera.
        seconds: of the film.
        fps: frames per second.
        size: width and height in pixels.
        background: colour where there are no points; dark by default.
        cameras: draw the cameras as lines, the due one in yellow; on the orbit only.
        progress: called with the number of frames done, and of all.

    Raises InputError for an unknown path, a size outside 16 to 4096, or a film of no frame or of more than 10000.
    """
    check_choice("path", path, get_args(Path))
    for name, side in zip(("width", "height"), size, strict=True):
        if not 16 <= whole_number(name, side, 1) <= MOST_SIDE:
            raise InputError(f"{name} is {side}; expected 16 to {MOST_SIDE} pixels")
    if not 0 < fps <= 120:
        raise InputError(f"fps is {fps!r}; expected a number above 0, at most 120")
    if not 0 < seconds * fps <= MOST_FRAMES:
        most = f"at most {MOST_FRAMES} frames at {fps:g} fps"
        raise InputError(f"seconds is {seconds!r}; expected above 0, and {most}")
    count = max(1, round(seconds * fps))
    due = due_frames(result, seconds, count, loops=path == "orbit")
    return _draw(result, path, due, size, background, cameras and path == "orbit", progress or no_progress)


def due_frames(result: Result, seconds: float, count: int, *, loops: bool) -> Int32[np.ndarray, " count"]:
    """Return which frame of the clip each of the `count` frames of a film of so many seconds shows."""
    frames, times = len(result.depth), result.timestamps
    duration = frames / PLAIN_RATE
    if times is not None and frames > 1 and (np.diff(times) > 0).all():
        duration = float(times[-1] - times[0]) * frames / (frames - 1)
    plays = max(1, round(seconds / duration)) if loops else 1
    plays = min(plays, max(1, count // frames))  # every frame is shown, where there are enough
    share = np.arange(count) * plays / count % 1
    return np.minimum(share * frames, frames - 1).astype(np.int32)


def _draw(
    result: Result,
    path: Path,
    due: Int32[np.ndarray, " count"],
    size: tuple[int, int],
    background: tuple[int, int, int],
    with_cameras: bool,
    progress: Progress,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    static, moving = shown_points(result, static_percentile=_LEFT_OUT, dynamic_percentile=_LEFT_OUT)
    real = Cameras(result.camera_from_world, result.intrinsics)
    depth = middle_depth(real, [static, *moving])
    _, height, width = result.depth.shape
    intrinsics = fitted_intrinsics(real, (width, height), size)
    virtual = _PATHS[path](real, intrinsics, depth, len(due))
    background_splats = _splats(result, static)
    lines = _cameras(result, depth) if with_cameras else None
    shown, splats = -1, background_splats
    kept: dict[int, Splats] = {}
    diameters = background_splats.diameters
    width = intrinsics[0, 0] / depth * float(np.median(diameters)) if len(diameters) else 0.0  # of a disc, in pixels
    factor = 1 if width > _WIDE else 2
    for number, frame in enumerate(due.tolist()):
        if frame != shown:
            if frame not in kept:  # the clip may be played again
                kept[frame] = _splats(result, moving[frame])
            shown, parts = frame, [background_splats, kept[frame]]
            if lines is not None:
                parts.append(_colored(lines, frame, depth / intrinsics[0, 0]))
            splats = Splats.joined(*parts)
        camera = Cameras(virtual.camera_from_world[number], virtual.intrinsics[number])
        yield draw_splats(splats, camera, size, background=background, near=_NEAR * depth, supersampling=factor)
        progress(number + 1, len(due))


def middle_depth(cameras: Cameras, points: list[ShownPoints]) -> float:
    """Return the depth of the scene's middle in the middle camera; 1 where it sees no point."""
    positions = np.concatenate([shown.positions for shown in points])
    chosen = middle_camera(cameras)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        _, _, depth = project(positions, cameras.camera_from_world[chosen], cameras.intrinsics[chosen])
    depth = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.percentile(depth, _MIDDLE)) if depth.size else 1.0


def _splats(result: Result, points: ShownPoints) -> Splats:
    return Splats(points.positions, points.values(result.images), point_widths(result, points))


def _cameras(result: Result, depth: float) -> Float32[np.ndarray, "S L 3"]:
    """Return points along the lines of all cameras."""
    _, height, width = result.depth.shape
    poses = result.camera_from_world.astype(np.float64)
    corners = frustum_corners(result.intrinsics, poses, height, width, _CAMERA_SIZE * depth)
    start, end = corners[:, FRUSTUM_EDGES[:, 0], None], corners[:, FRUSTUM_EDGES[:, 1], None]  # [S, 8, 1, 3]
    share = np.linspace(0, 1, _EDGE_POINTS, dtype=np.float32)[:, None]
    with np.errstate(over="ignore"):  # what is infinitely far is not drawn
        return (start + share * (end - start)).reshape(len(corners), -1, 3).astype(np.float32)


def _colored(lines: Float32[np.ndarray, "S L 3"], due: int, pixel: float) -> Splats:
    """Return the lines of the due camera and of some others; `pixel` is its width at the middle's depth."""
    frames, count, _ = lines.shape
    shown = np.unique(np.append(np.linspace(0, frames - 1, min(frames, _MOST_CAMERAS)).round().astype(int), due))
    is_due = np.repeat(shown == due, count)
    colors = np.where(is_due[:, None], _DUE, _FAINT).astype(np.uint8)
    width = np.where(is_due, _DUE_LINE, _LINE) * pixel
    return Splats(lines[shown].reshape(-1, 3), colors, width.astype(np.float32))
