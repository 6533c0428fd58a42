"""A picture of a result beside the truth: depth, mask, and the path of the cameras from above."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from vggtjax.clips.truth import Truth
from vggtjax.evaluation.metrics.depth import median_scale
from vggtjax.geometry.similarity import centres, moves, umeyama_sim3
from vggtjax.reconstruction import Reconstruction
from vggtjax.results.previews import BACKGROUND, FAINT, TEXT, color_depth, inverse_depth_range, overlay

_FRAMES = 6
_SIDE = 220  # of a picture, in pixels
_MARGIN, _GAP, _LABEL, _PLOT = 24, 6, 130, 460
_TRUE, _FOUND, _PREDICTED = (120, 200, 255), (255, 150, 60), (150, 150, 160)


def truth_sheet(
    result: Reconstruction, truth: Truth, predicted: Reconstruction | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw frames of a result with exact truth: pictures, depth and masks (found and true), cameras from above.

    Depth is scaled to the truth by the median ratio, cameras are aligned by a similarity. `predicted` is the result
    before depth and cameras were made consistent, to draw beside it.
    """
    S, H, W = result.depth.shape
    shown = np.linspace(0, S - 1, min(S, _FRAMES)).round().astype(int)
    size = (_SIDE, round(_SIDE * H / W))
    depths = {} if predicted is None else {"Depth predicted": predicted.depth}
    depths |= {"Depth found": result.depth, "Depth true": np.asarray(truth.depth)}
    found = ("Moving found",) if result.has_mask else ()
    rows = ("Picture", *depths, *found, "Moving true")
    left, top = _MARGIN + _LABEL, _MARGIN + 40
    plot_left = left + len(shown) * (size[0] + _GAP) + 2 * _MARGIN
    height = top + len(rows) * (size[1] + _GAP) + _MARGIN
    sheet = Image.new("RGB", (plot_left + _PLOT + _MARGIN, max(height, top + _PLOT + 80)), BACKGROUND)
    draw, font, small = ImageDraw.Draw(sheet), ImageFont.load_default(22), ImageFont.load_default(15)
    draw.text((_MARGIN, _MARGIN - 6), f"{result.method}  ·  {result.model_name}  ·  against the truth", TEXT, font)

    everywhere = np.ones(result.depth.shape, bool)
    true_depth = np.asarray(truth.depth, np.float32)
    scaled = [(depth * median_scale(depth, true_depth)).astype(np.float32) for depth in depths.values()]
    inverse_range = inverse_depth_range(true_depth, everywhere)
    for row, label in enumerate(rows):
        draw.text((_MARGIN, top + row * (size[1] + _GAP)), label, TEXT, small)
    for column, frame in enumerate(shown):
        image = result.images[frame]
        pictures = (
            image,
            *(color_depth(depth[frame], everywhere[frame], inverse_range) for depth in scaled),
            *([overlay(image, result.dynamic_mask[frame])] if result.has_mask else ()),
            overlay(image, truth.dynamic_mask[frame]),
        )
        for row, picture in enumerate(pictures):
            place = left + column * (size[0] + _GAP), top + row * (size[1] + _GAP)
            sheet.paste(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC), place)
    found = {} if predicted is None else {"predicted": (predicted.camera_from_world, _PREDICTED)}
    found |= {"found": (result.camera_from_world, _FOUND)}
    _draw_cameras(draw, (plot_left, top), small, found, np.asarray(truth.camera_from_world))
    return np.asarray(sheet)


def _draw_cameras(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
    found: dict[str, tuple[Float[np.ndarray, "S 3 4"], tuple[int, int, int]]],
    true: Float[np.ndarray, "S 3 4"],
) -> None:
    """Plot centres from above, x to the right and z up, in the axes of the true first camera; `found` by name."""
    true_rotation, origin = true[0, :, :3], centres(true)[0]
    ways = {"true": (centres(true), _TRUE)}
    for name, (poses, colour) in found.items():
        if moves(centres(true)) and moves(centres(poses)):
            aligned = umeyama_sim3(centres(poses), centres(true), allow_line=True).apply(centres(poses))
            ways[name] = (aligned, colour)
    flat = {name: ((way - origin) @ true_rotation.T)[:, [0, 2]] for name, (way, _) in ways.items()}
    points = np.concatenate(list(flat.values()))
    middle, span = (points.max(0) + points.min(0)) / 2, max(np.ptp(points, axis=0).max(), 1e-9)
    draw.text(corner, "Cameras from above", TEXT, font)
    for i, (name, way) in enumerate(flat.items()):
        colour = ways[name][1]
        draw.text((corner[0] + 90 * i, corner[1] + 22), name, colour, font)
        pixels = (way - middle) / span * (_PLOT - 80) * [1, -1] + [corner[0] + _PLOT / 2, corner[1] + 40 + _PLOT / 2]
        draw.line([tuple(p) for p in pixels], fill=colour, width=9 if name == "true" else 3)  # seen below the others
        for x, y in pixels:
            draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=colour)
        x, y = pixels[0]
        draw.ellipse((x - 8, y - 8, x + 8, y + 8), outline=colour, width=2)
    draw.text((corner[0], corner[1] + _PLOT + 30), f"square of {span:.2f} m; ring: first frame", FAINT, font)
