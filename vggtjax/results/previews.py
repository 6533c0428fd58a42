"""Pictures of a result: coloured depth, masks over the frames, and a contact sheet of the clip."""

from __future__ import annotations

from collections.abc import Iterator
from colorsys import hsv_to_rgb

import numpy as np
import skimage
from jaxtyping import Bool, Float, Float32, Int, UInt8
from PIL import Image

from vggtjax.progress import Progress, no_progress
from vggtjax.results.colors import color_ramp
from vggtjax.results.grid import BACKGROUND, Row, draw_grid, fitted
from vggtjax.results.result import Result
from vggtjax.storage.arrays import spread_frames

DEPTH_COLORS = color_ramp("turbo")  # far cold, near warm
SALIENCY_COLORS = color_ramp("inferno")
MOST_MOTION = 5  # times the median: the brightest motion
CONFIDENCE_COLORS = color_ramp("viridis")  # unsure dark, sure bright
_NO_DEPTH = np.array([40, 40, 46], np.uint8)
# Of objects by id: hues spaced by the golden ratio; black for no object.
INSTANCE_COLORS = np.array(
    [(0, 0, 0), (255, 40, 90)]
    + [tuple(round(255 * c) for c in hsv_to_rgb((0.96 + 0.618034 * i) % 1, 0.84, 1)) for i in range(1, 255)],
    np.uint8,
)
_OUTLINE = np.array([255, 235, 60], np.uint8)

_LEAST_SIDE = 480  # pixels of the longer side of a frame's preview
_MOST_SAMPLES = 2_000_000  # pixels of a percentile
_SHEET_FRAMES = 8
_SHEET_WIDTH = 1800  # pixels of all columns
_THUMBNAIL = (480, 300)  # widest and highest


def inverse_depth_range(depth: Float32[np.ndarray, "S H W"], valid: Bool[np.ndarray, "S H W"]) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of 1/depth over the valid pixels of a clip, (0, 1) without any."""
    depth, valid = spread_frames(depth, valid)
    if not valid.any():
        return 0.0, 1.0
    with np.errstate(over="ignore"):
        inverse = 1 / depth[valid].astype(np.float64)
    far, near = np.percentile(inverse, (2, 98))
    return float(far), float(near)


def color_depth(
    depth: Float32[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], inverse_range: tuple[float, float]
) -> UInt8[np.ndarray, "H W 3"]:
    """Colour inverse depth from blue, at or beyond the first of `inverse_range`, to red; grey where not valid."""
    far, near = inverse_range
    inverse = 1 / np.where(valid, depth, 1).astype(np.float64)
    level = np.clip((inverse - far) / max(near - far, np.finfo(np.float64).tiny), 0, 1)
    return np.where(valid[..., None], DEPTH_COLORS[(level * 255).round().astype(np.uint8)], _NO_DEPTH)


def log_confidence_range(
    confidence: Float32[np.ndarray, "S H W"], valid: Bool[np.ndarray, "S H W"]
) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of log confidence over the valid pixels of a clip, (0, 1) without any."""
    confidence, valid = spread_frames(confidence, valid)
    values = confidence[valid & (confidence > 0)]
    if not len(values):
        return 0.0, 1.0
    low, high = np.percentile(values[:: max(1, len(values) // _MOST_SAMPLES)].astype(np.float64), (2, 98))
    return float(np.log(low)), float(np.log(high))


def color_confidence(
    confidence: Float32[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], log_range: tuple[float, float]
) -> UInt8[np.ndarray, "H W 3"]:
    """Colour log confidence from dark, at or below the first of `log_range`, to bright; grey where not valid."""
    low, high = log_range
    usable = valid & (confidence > 0)
    level = (np.log(np.where(usable, confidence, 1).astype(np.float64)) - low) / max(high - low, 1e-12)
    colored = CONFIDENCE_COLORS[(level.clip(0, 1) * 255).round().astype(np.uint8)]
    return np.where(usable[..., None], colored, _NO_DEPTH)


def overlay(
    image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"] | UInt8[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Tint and outline moving pixels, of a mask or of objects by id, each in a colour of its own.

    Static pixels lose half of their colour, so that the tint shows on any hue.
    """
    grey = image.mean(axis=-1, keepdims=True)
    ids = moving.astype(np.uint8)
    tinted = 0.55 * image + 0.45 * INSTANCE_COLORS[ids]
    drawn = np.where(ids[..., None] > 0, tinted, 0.5 * image + 0.5 * grey).round().astype(np.uint8)
    drawn[skimage.segmentation.find_boundaries(ids, mode="thick")] = _OUTLINE
    return drawn


def moving_ids(mask: Bool[np.ndarray, ...], instances: UInt8[np.ndarray, ...]) -> UInt8[np.ndarray, ...]:
    """Return the objects' ids, and the last id for moving regions too small for an object."""
    return np.where(mask & (instances == 0), len(INSTANCE_COLORS) - 1, instances).astype(np.uint8)


def enlarged(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the width and height to show pictures of this height and width at: a whole multiple, easily seen."""
    height, width = shape[:2]
    factor = max(1, -(-_LEAST_SIDE // max(height, width)))
    return width * factor, height * factor


def depth_picture(
    depth: Float32[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], inverse_range: tuple[float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return coloured depth, enlarged to see it."""
    picture = Image.fromarray(color_depth(depth, valid, inverse_range))
    return np.asarray(picture.resize(enlarged(depth.shape), Image.Resampling.LANCZOS))


def overlay_picture(
    image: UInt8[np.ndarray, "H W 3"], moving: UInt8[np.ndarray, "H W"], size: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the overlay at this width and height, by default enlarged to see it, with a sharp outline of one width."""
    size = size or enlarged(moving.shape)
    picture = Image.fromarray(image).resize(size, Image.Resampling.LANCZOS)
    return overlay(np.asarray(picture), np.asarray(Image.fromarray(moving).resize(size, Image.Resampling.NEAREST)))


def card(result: Result) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the middle frame: picture, depth and, where a mask tells them, moving objects beside each other."""
    frame = len(result.depth) // 2
    valid = result.valid_pixels
    depth = depth_picture(result.depth[frame], valid[frame], inverse_depth_range(result.depth, valid))
    moving = moving_ids(result.dynamic_mask[frame], result.instances[frame])
    picture = Image.fromarray(result.images[frame]).resize(enlarged(moving.shape), Image.Resampling.LANCZOS)
    gap = np.full((len(depth), max(4, depth.shape[1] // 60), 3), BACKGROUND, np.uint8)
    last = [gap, overlay_picture(result.images[frame], moving)] if result.has_mask else []
    return np.hstack([np.asarray(picture), gap, depth, *last])


def layer_frames(result: Result, progress: Progress | None = None) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Draw each frame two by two: picture and depth above confidence and moving objects."""
    valid, size = result.valid_pixels, enlarged(result.depth.shape[1:])
    inverse_range = inverse_depth_range(result.depth, valid)
    log_range = log_confidence_range(result.depth_confidence, valid)
    for frame, picture in enumerate(result.images):
        moving = moving_ids(result.dynamic_mask[frame], result.instances[frame])
        confidence = color_confidence(result.depth_confidence[frame], valid[frame], log_range)
        large, sure = (np.asarray(Image.fromarray(each).resize(size)) for each in (picture, confidence))
        depth = depth_picture(result.depth[frame], valid[frame], inverse_range)
        yield np.vstack([np.hstack([large, depth]), np.hstack([sure, overlay_picture(picture, moving)])])
        (progress or no_progress)(frame + 1, len(valid))


def contact_sheet(result: Result) -> UInt8[np.ndarray, "height width 3"]:
    """Draw up to eight frames, evenly spread: rows of pictures, depth, what tells motion, moving objects."""
    frames, height, width = result.depth.shape
    shown = np.linspace(0, frames - 1, min(frames, _SHEET_FRAMES)).round().astype(int)
    size = fitted((height, width), (min(_THUMBNAIL[0], _SHEET_WIDTH // len(shown)), _THUMBNAIL[1]))
    count = f"{frames} frame{'s' if frames > 1 else ''} of {width} x {height} pixels"
    times = ["" if result.timestamps is None else f"  ·  {result.timestamps[frame]:.2f} s" for frame in shown]
    columns = [f"frame {frame}{time}" for frame, time in zip(shown, times, strict=True)]
    title = f"{result.method}  ·  {result.model_name}"
    return draw_grid(title, columns, _rows(result, shown, size), size, f"{count}\n{result.model_note}".strip())


def _rows(result: Result, shown: Int[np.ndarray, " F"], size: tuple[int, int]) -> list[Row]:
    valid = result.valid_pixels
    inverse_range = inverse_depth_range(result.depth, valid)
    depths = [color_depth(result.depth[frame], valid[frame], inverse_range) for frame in shown]
    rows = [Row("Picture", [*result.images[shown]]), Row("Depth", depths, ramp=(DEPTH_COLORS, "far", "near"))]
    if result.saliency is not None and np.nan_to_num(result.saliency).any():
        rows.append(Row("Saliency", [_heat(x, size) for x in result.saliency[shown]], ramp=(SALIENCY_COLORS, "0", "1")))
    if result.motion is not None:
        above = (result.motion[shown] - 1) / (MOST_MOTION - 1)
        ramp = (SALIENCY_COLORS, "median", f"{MOST_MOTION} x")
        rows.append(Row("Motion", [_heat(x, size) for x in above], ramp=ramp))
    if result.has_mask:
        objects = int(result.instances.max())
        notes = f"{result.dynamic_share:.1%} of pixels\n{objects} object{'' if objects == 1 else 's'}"
        ids = moving_ids(result.dynamic_mask[shown], result.instances[shown])
        overlaid = [overlay_picture(*frame, size) for frame in zip(result.images[shown], ids, strict=True)]
        rows.append(Row("Dynamic", overlaid, notes))
    return rows


def _heat(values: Float[np.ndarray, "h w"], size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Colour numbers of patches from 0 to 1, enlarged before: mixed colours would lie beside the ramp."""
    patches = Image.fromarray(np.nan_to_num(values).clip(0, 1).astype(np.float32))
    return SALIENCY_COLORS[(np.asarray(patches.resize(size, Image.Resampling.BILINEAR)) * 255).round().astype(np.uint8)]
