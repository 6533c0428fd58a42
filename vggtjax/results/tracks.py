"""Pictures of tracks: drawn over the frames as a strip and as a video."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from vggtjax.results.colors import hues
from vggtjax.results.grid import Row, draw_grid, fitted
from vggtjax.results.rendering.film import mp4_codec, write_film
from vggtjax.results.result import Result

SEEN = 0.5  # visibility from which a point is drawn filled
_COLORS = hues(256)
_TAIL = 8  # frames of a point's past that are drawn
_STRIP_FRAMES, _STRIP_WIDTH = 6, 1800
_VIDEO_SIDE = 720  # least pixels of the video's longer side; frames are enlarged by whole numbers
_FRAMES_PER_SECOND = 10

logger = logging.getLogger(__name__)


def track_strip(result: Result) -> UInt8[np.ndarray, "height width 3"]:
    """Draw up to six frames, evenly spread, with the position and the past of every track."""
    S, H, W = result.depth.shape
    shown = np.linspace(0, S - 1, min(S, _STRIP_FRAMES)).round().astype(int)
    size = fitted((H, W), (_STRIP_WIDTH // len(shown), _STRIP_WIDTH))
    count = _present(result.track_frames).size
    frames = [np.asarray(_drawn(result, int(frame), size)) for frame in shown]
    columns = [f"frame {frame}" for frame in shown]
    return draw_grid(f"{count} track{'s' if count > 1 else ''}", columns, [Row("", frames)], size)


def write_track_video(path: Path, result: Result) -> None:
    """Write the clip with its tracks as an mp4; log a note if PyAV has no encoder for it."""
    if mp4_codec() is None:
        logger.info("tracks are drawn as pictures only; this PyAV has no encoder for an mp4")
        return
    S, H, W = result.depth.shape
    factor = max(1, -(-_VIDEO_SIDE // max(H, W)))
    size = (W * factor // 2 * 2, H * factor // 2 * 2)  # an .mp4 has even sides
    write_film(path, (np.asarray(_drawn(result, frame, size)) for frame in range(S)), _FRAMES_PER_SECOND)


def _drawn(result: Result, frame: int, size: tuple[int, int]) -> Image.Image:
    """Return a frame, greyed and enlarged, with the tracks over it; hidden points are rings."""
    positions, visibility = _present(result.track_positions), _present(result.track_visibility)
    _, H, W = result.depth.shape
    scale = np.array(size) / (W, H)
    picture = Image.fromarray(result.images[frame]).resize(size, Image.Resampling.LANCZOS)
    picture = Image.blend(picture, picture.convert("L").convert("RGB"), 0.6)
    draw = ImageDraw.Draw(picture)
    places = np.nan_to_num(positions * scale).clip(-1e4, 1e4)
    radius = max(2.0, min(size) / 150)
    x, y = (positions[0] - [W / 2, H / 2]).T  # the direction from the middle of the first frame gives the colour
    angle = (np.arctan2(y, x) / (2 * np.pi)) % 1
    colors = _COLORS[np.minimum((angle * 256).astype(int), 255)].tolist()
    for track, color in enumerate(map(tuple, colors)):
        past = places[max(0, frame - _TAIL) : frame + 1, track]
        if len(past) > 1:
            draw.line([tuple(point) for point in past.tolist()], fill=color, width=max(1, round(radius / 2)))
        x, y = past[-1]
        box = (x - radius, y - radius, x + radius, y + radius)
        draw.ellipse(box, fill=color if visibility[frame, track] >= SEEN else None, outline=color)
    return picture


def _present(value: np.ndarray | None) -> np.ndarray:
    if value is None:
        raise ValueError("this result has no tracks")
    return value
