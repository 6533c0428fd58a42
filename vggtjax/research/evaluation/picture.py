"""A picture of a result beside the truth: depth, mask, and the path of the cameras from above."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from vggtjax.cameras import checked_centres, moves, umeyama_sim3
from vggtjax.clips.truth import Truth
from vggtjax.research.evaluation.metrics.depth import median_scale
from vggtjax.results.grid import BACKGROUND, FAINT, MARGIN, TEXT, Row, draw_grid, fitted
from vggtjax.results.previews import color_depth, inverse_depth_range, overlay
from vggtjax.results.reconstruction import Reconstruction

_FRAMES = 6
_SIDE = 220  # of a picture, in pixels
_PLOT = 460
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
    true_depth, everywhere = np.asarray(truth.depth, np.float32), np.ones((H, W), bool)
    inverse_range = inverse_depth_range(true_depth, np.ones((S, H, W), bool))
    depths = {} if predicted is None else {"Depth predicted": predicted.depth}
    depths |= {"Depth found": result.depth, "Depth true": true_depth}
    masks = {"Moving found": result.dynamic_mask} if result.has_mask else {}
    masks |= {"Moving true": np.asarray(truth.dynamic_mask)}
    rows = [Row("Picture", [*result.images[shown]])]
    for label, depth in depths.items():
        scaled = (depth * median_scale(depth, true_depth)).astype(np.float32)[shown]
        rows.append(Row(label, [color_depth(frame, everywhere, inverse_range) for frame in scaled]))
    rows += [Row(name, [overlay(result.images[i], mask[i]) for i in shown]) for name, mask in masks.items()]
    title = f"{result.method}  ·  {result.model_name}  ·  against the truth"
    sheet = draw_grid(title, [f"frame {frame}" for frame in shown], rows, fitted((H, W), (_SIDE, 2 * _SIDE)))
    found = {} if predicted is None else {"predicted": (predicted.camera_from_world, _PREDICTED)}
    found |= {"found": (result.camera_from_world, _FOUND)}
    cameras = _cameras_from_above(found, np.asarray(truth.camera_from_world))
    canvas = np.full((max(len(sheet), len(cameras)), sheet.shape[1] + cameras.shape[1], 3), BACKGROUND, np.uint8)
    canvas[: len(sheet), : sheet.shape[1]], canvas[: len(cameras), sheet.shape[1] :] = sheet, cameras
    return canvas


def _cameras_from_above(
    found: dict[str, tuple[Float[np.ndarray, "S 3 4"], tuple[int, int, int]]], true: Float[np.ndarray, "S 3 4"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Plot centres from above, x to the right and z up, in the axes of the true first camera; `found` by name."""
    picture = Image.new("RGB", (_PLOT + MARGIN, _PLOT + 2 * MARGIN + 60), BACKGROUND)
    draw, font, corner = ImageDraw.Draw(picture), ImageFont.load_default(15), (0, MARGIN + 12)
    true_rotation, origin = true[0, :, :3], checked_centres(true)[0]
    ways = {"true": (checked_centres(true), _TRUE)}
    for name, (poses, colour) in found.items():
        way, true_way = checked_centres(poses), checked_centres(true)
        if moves(true_way) and moves(way):
            ways[name] = (umeyama_sim3(way, true_way, allow_line=True).apply(way), colour)
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
    return np.asarray(picture)
