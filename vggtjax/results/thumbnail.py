"""A small moving picture of a result's points, from a coarse copy of the result, so that it is made in seconds."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from PIL import Image

from vggtjax.results.films import film_frames
from vggtjax.results.result import TRACKS, FieldOfViewWarning, Result

_FRAMES, _SECONDS, _SIDE = 24, 4.0, 360  # of the film; the longer side in pixels
_MOST_ENLARGED = 5  # times the result's own pixels: wider discs take long to draw and show no more
_CLIP_FRAMES, _CLIP_PIXELS = 40, 240_000  # most of the coarse copy
_MOST_BYTES = 1_100_000
_QUALITIES = (68, 45, 25, 10)  # of WebP; the next one where a film is too large


class MovingThumbnail(NamedTuple):
    """Two WebP files: the film, which repeats, and its first frame."""

    film: bytes
    still: bytes


def moving_thumbnail(result: Result) -> MovingThumbnail | None:
    """Return the points of a result as a short film around the scene, or None where it has no points."""
    if not result.valid_pixels.any():
        return None
    height, width = result.depth.shape[1:]
    scale = min(_SIDE / max(height, width), _MOST_ENLARGED)
    size = max(16, round(width * scale)), max(16, round(height * scale))
    frames = film_frames(coarse(result), seconds=_SECONDS, fps=_FRAMES / _SECONDS, size=size)
    pictures = [Image.fromarray(frame) for frame in frames]
    film = b""
    for quality in _QUALITIES:
        film = _webp(pictures, quality)
        if len(film) <= _MOST_BYTES:
            break
    return MovingThumbnail(film, _webp(pictures[:1], _QUALITIES[0]))


def _webp(pictures: list[Image.Image], quality: int) -> bytes:
    file = io.BytesIO()
    first, *others = pictures
    time = round(1000 * _SECONDS / _FRAMES)
    more = {"save_all": True, "append_images": others, "duration": time, "loop": 0} if others else {}
    first.save(file, "WEBP", quality=quality, method=2, **more)
    return file.getvalue()


def coarse(result: Result) -> Result:
    """Return a result of at most `_CLIP_FRAMES` frames, evenly spread, and of every n-th row and column.

    The points are some of the result's. At most about `_CLIP_PIXELS` are left in all frames; padding has depth 0.
    """
    count, height, width = result.depth.shape
    frames = np.linspace(0, count - 1, min(count, _CLIP_FRAMES)).round().astype(int)
    step = max(1, int(np.ceil(np.sqrt(len(frames) * height * width / _CLIP_PIXELS))))
    step = min(step, height, width)
    first = (step - 1) // 2
    taken = np.s_[first : first + height // step * step : step, first : first + width // step * step : step]

    def of(array: np.ndarray) -> np.ndarray:
        return array[frames][:, *taken]

    valid = of(result.valid_pixels)
    intrinsics = result.intrinsics[frames].copy()
    intrinsics[:, :2, 2] = (intrinsics[:, :2, 2] - first - 0.5) / step + 0.5
    intrinsics[:, [0, 1], [0, 1]] /= step
    depth = np.where(valid, of(result.depth), 0).astype(np.float32)
    with warnings.catch_warnings():  # the field of view of a camera at the limit changes by a part of a pixel
        warnings.simplefilter("ignore", FieldOfViewWarning)
        return replace(
            result,
            depth=depth,
            depth_confidence=np.where(valid, of(result.depth_confidence), 1).astype(np.float32),
            dynamic_mask=of(result.dynamic_mask),
            camera_from_world=result.camera_from_world[frames],
            intrinsics=intrinsics,
            images=of(result.images),
            frame_names=tuple(result.frame_names[frame] for frame in frames),
            timestamps=None if result.timestamps is None else result.timestamps[frames],
            settings={},
            source_size=result.source_size[frames],
            source_scale=result.source_scale[frames] * step,
            source_offset=result.source_offset[frames],
            valid_box=np.tile([0, 0, depth.shape[2], depth.shape[1]], (len(frames), 1)),
            **dict.fromkeys(("saliency", "motion", "passes", *TRACKS)),
        )
