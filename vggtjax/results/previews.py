"""Pictures of a result: coloured depth, masks over the frames, and a contact sheet of the clip."""

from __future__ import annotations

from colorsys import hsv_to_rgb

import numpy as np
import skimage
from cmap import Colormap
from jaxtyping import Bool, Float32, UInt8
from PIL import Image, ImageDraw, ImageFont

from vggtjax.results.result import Result
from vggtjax.storage.arrays import spread_frames


def color_ramp(name: str) -> UInt8[np.ndarray, "256 3"]:
    """Return the colours of a colour map from its first to its last."""
    return (Colormap(name).lut(256)[:, :3] * 255).round().astype(np.uint8)


DEPTH_COLORS = color_ramp("turbo")  # far cold, near warm
SALIENCY_COLORS = color_ramp("inferno")
MOST_MOTION = 5  # times the median: the brightest motion by matches
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
_TITLE_WIDTH = 700  # least pixels of the title
_THUMBNAIL = (480, 300)  # widest and highest
_MARGIN, _GAP, _LABEL_WIDTH, _LEGEND_WIDTH, _HEADER_HEIGHT = 24, 6, 150, 120, 104
BACKGROUND, TEXT, FAINT = (20, 20, 24), (236, 236, 240), (150, 150, 160)  # of every sheet


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


def overlay_picture(image: UInt8[np.ndarray, "H W 3"], moving: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the overlay, enlarged to see it, with a sharp outline."""
    size = enlarged(moving.shape)
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


def contact_sheet(result: Result) -> UInt8[np.ndarray, "height width 3"]:
    """Draw up to eight frames, evenly spread: columns of picture, depth, what tells motion, moving objects."""
    frames, height, width = result.depth.shape
    shown = np.linspace(0, frames - 1, min(frames, _SHEET_FRAMES)).round().astype(int)
    scale = min(_THUMBNAIL[0] / width, _THUMBNAIL[1] / height, _SHEET_WIDTH / len(shown) / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    step_x, step_y = size[0] + _GAP, size[1] + _GAP
    left, top = _MARGIN + _LABEL_WIDTH, _MARGIN + _HEADER_HEIGHT

    labels = tuple(_thumbnails(result, 0, np.zeros((height, width, 3), np.uint8), size))

    sheet_width = max(left + len(shown) * step_x - _GAP, _TITLE_WIDTH) + _MARGIN
    sheet = Image.new("RGB", (sheet_width, top + len(labels) * step_y - _GAP + _MARGIN), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    large, small = ImageFont.load_default(22), ImageFont.load_default(15)
    draw.text((_MARGIN, _MARGIN), f"{result.method}  ·  {result.model_name}", TEXT, large)
    count = f"{frames} frame{'s' if frames > 1 else ''} of {width} x {height} pixels"
    draw.text((_MARGIN, _MARGIN + 30), count, FAINT, small)
    draw.text((_MARGIN, _MARGIN + 48), result.model_note, FAINT, small)

    objects = int(result.instances.max())
    notes = (f"{result.dynamic_share:.1%} of pixels", f"{objects} object{'' if objects == 1 else 's'}")
    legends = {"Depth": (DEPTH_COLORS, "far", "near"), "Saliency": (SALIENCY_COLORS, "0", "1")}
    legends["By matches"] = (SALIENCY_COLORS, "median", f"{MOST_MOTION} x")
    for row, label in enumerate(labels):
        y = top + row * step_y
        draw.text((_MARGIN, y), label, TEXT, small)
        if label in legends:
            colors, lowest, highest = legends[label]
            sheet.paste(Image.fromarray(colors[None]).resize((_LEGEND_WIDTH, 10)), (_MARGIN, y + 24))
            draw.text((_MARGIN, y + 38), lowest, FAINT, small)
            draw.text((_MARGIN + _LEGEND_WIDTH, y + 38), highest, FAINT, small, "ra")
        if label == "Dynamic":
            draw.text((_MARGIN, y + 22), "\n".join(notes), FAINT, small)

    valid = result.valid_pixels
    inverse_range = inverse_depth_range(result.depth, valid)
    for column, frame in enumerate(shown):
        x = left + column * step_x
        time = "" if result.timestamps is None else f"  ·  {result.timestamps[frame]:.2f} s"
        draw.text((x, top - 24), f"frame {frame}{time}", FAINT, small)
        depth = color_depth(result.depth[frame], valid[frame], inverse_range)
        for row, thumbnail in enumerate(_thumbnails(result, int(frame), depth, size).values()):
            sheet.paste(thumbnail, (x, top + row * step_y))
    return np.asarray(sheet)


def _thumbnails(
    result: Result, frame: int, depth: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]
) -> dict[str, Image.Image]:
    """Return one column of the sheet, from top to bottom."""
    picture = Image.fromarray(result.images[frame]).resize(size, Image.Resampling.LANCZOS)
    column = {"Picture": picture, "Depth": Image.fromarray(depth).resize(size, Image.Resampling.LANCZOS)}
    if result.saliency is not None and np.nan_to_num(result.saliency).any():
        saliency = np.nan_to_num(result.saliency[frame]).clip(0, 1)
        saliency = np.asarray(Image.fromarray(saliency).resize(size, Image.Resampling.BILINEAR))
        column["Saliency"] = Image.fromarray(SALIENCY_COLORS[(saliency * 255).round().astype(np.uint8)])
    if result.motion is not None:
        above = (result.motion[frame] - 1) / (MOST_MOTION - 1)
        motion = Image.fromarray(np.nan_to_num(above).clip(0, 1).astype(np.float32))
        motion = np.asarray(motion.resize(size, Image.Resampling.BILINEAR))
        column["By matches"] = Image.fromarray(SALIENCY_COLORS[(motion * 255).round().astype(np.uint8)])
    if not result.has_mask:
        return column
    moving = Image.fromarray(moving_ids(result.dynamic_mask[frame], result.instances[frame]))
    moving = np.asarray(moving.resize(size, Image.Resampling.NEAREST))
    return column | {"Dynamic": Image.fromarray(overlay(np.asarray(picture), moving))}
