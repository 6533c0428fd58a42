"""The sweep as a picture: one cell per map, coloured by its area under the ROC curve."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, ImageDraw, ImageFont

from vggtjax.errors import one_line
from vggtjax.research.calibration.choice import Choice
from vggtjax.research.calibration.sweep import GRAMS, KINDS, kind_index
from vggtjax.results.colors import color_ramp
from vggtjax.results.grid import BACKGROUND, FAINT, TEXT

# Blue below one half, red above.
_COLORS = color_ramp("RdBu_r")
_DARK, _OUTLINE = (20, 20, 24), (30, 200, 90)
_CELL, _GAP, _MARGIN = (46, 30), 26, 24  # width and height; between the similarities; around everything
_LABEL_WIDTH, _HEADER_HEIGHT, _LINE, _LEGEND = 150, 96, 22, (256, 12)
_COLUMNS = (_MARGIN, 600, 700)  # left edges of the table below the cells
_LEAST_WIDTH = 800  # pixels; enough for the title, the legend and that table
_MOST_LETTERS = 32  # of the title
_LEAST_REACH = 0.1  # smallest range of the colours on either side of 0.5, so that noise looks pale


def draw_sweep(auc: Float64[np.ndarray, "G C L"], choice: Choice, *, title: str = "") -> UInt8[np.ndarray, "H W 3"]:
    """Draw areas under the ROC curve: rows are similarity, Gram map and statistic, columns are pairs.

    The chosen cues are outlined and numbered in the order of choice; one over several pairs spans their columns.
    """
    G, C, L = auc.shape
    reach = max(float(np.abs(auc - 0.5).max()), _LEAST_REACH)
    left, top = _MARGIN + _LABEL_WIDTH, _MARGIN + _HEADER_HEIGHT
    bottom = top + G * (C * _CELL[1] + _GAP)
    width = max(left + L * _CELL[0], _LEAST_WIDTH) + _MARGIN
    sheet = Image.new("RGB", (width, bottom + (len(choice.steps) + 2) * _LINE + _MARGIN), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    large, small, tiny = (ImageFont.load_default(size) for size in (22, 15, 12))
    draw.text((_MARGIN, _MARGIN), f"Motion cues of {one_line(title, _MOST_LETTERS) or 'the model'}", TEXT, large)
    draw.text((_MARGIN, _MARGIN + 32), "area under the ROC curve of every pair's map for moving tokens", FAINT, small)
    _draw_legend(sheet, draw, small, reach, width)

    for layer in range(L):
        draw.text((left + (layer + 0.5) * _CELL[0], top - 8), str(layer), FAINT, small, "ms")
    draw.text((left - 12, top - 8), "pair", FAINT, small, "rs")
    for g, c, layer in np.ndindex(G, C, L):
        x, y = left + layer * _CELL[0], _row(top, g, c)
        value = float(auc[g, c, layer])
        color = _COLORS[round(255 * (0.5 + (value - 0.5) / (2 * reach)))]
        draw.rectangle((x, y, x + _CELL[0] - 2, y + _CELL[1] - 2), tuple(color.tolist()))
        ink = _DARK if color.mean() > 110 else TEXT
        draw.text((x + _CELL[0] / 2 - 1, y + _CELL[1] - 10), f"{value:.2f}", ink, tiny, "mm")  # below numbers of cues
        if layer == 0:
            text = f"{GRAMS[g]}  {(KINDS[c].rows + KINDS[c].columns).upper()} {KINDS[c].statistic}"
            draw.text((left - 12, y + _CELL[1] / 2), text, TEXT, small, "rm")

    corners: dict[tuple[int, int], list[int]] = {}  # of the outlines, with the numbers of the cues that begin there
    for number, step in enumerate(choice.steps, 1):
        x = left + step.cue.layers[0] * _CELL[0]
        y = _row(top, GRAMS.index(choice.gram), kind_index(step.cue))
        right = x + len(step.cue.layers) * _CELL[0]
        draw.rectangle((x - 2, y - 2, right, y + _CELL[1]), outline=_OUTLINE, width=3)
        corners.setdefault((x, y), []).append(number)
    for (x, y), numbers in corners.items():
        text = ", ".join(map(str, numbers))
        draw.rectangle((x - 2, y - 2, x + 4 + draw.textlength(text, tiny), y + 12), _OUTLINE)
        draw.text((x + 1, y + 5), text, _DARK, tiny, "lm")
    floor = f", floor {choice.motion.floor:g}" if choice.motion.floor else ""
    heading = f"Chosen for {choice.gram} similarity{floor}; AUC of the product up to each cue"
    rows: list[tuple[str, ...]] = [(heading, "calibration", "held-out half")]
    for number, (cue, rating) in enumerate(choice.steps, 1):
        name = f"{number}  {cue.name}{'  (1 - m)' if cue.inverted else ''}"
        rows.append((name, *(f"{area:.3f}" for area in rating)))
    rows.append(("default table", *(f"{area:.3f}" for area in choice.table)))
    for number, row in enumerate(rows):
        ink = TEXT if 0 < number < len(rows) - 1 else FAINT
        for text, x in zip(row, _COLUMNS, strict=True):
            draw.text((x, bottom + number * _LINE), text, ink, small)
    return np.asarray(sheet)


def _row(top: int, g: int, c: int) -> int:
    return top + g * (len(KINDS) * _CELL[1] + _GAP) + c * _CELL[1]


def _draw_legend(sheet: Image.Image, draw: ImageDraw.ImageDraw, font, reach: float, width: int) -> None:
    x, y = width - _MARGIN - _LEGEND[0], _MARGIN + 6
    sheet.paste(Image.fromarray(_COLORS[None]).resize(_LEGEND), (x, y))
    for share, anchor in ((0, "la"), (0.5, "ma"), (1, "ra")):
        text = f"{0.5 + (share - 0.5) * 2 * reach:.2f}"
        draw.text((x + share * _LEGEND[0], y + _LEGEND[1] + 4), text, FAINT, font, anchor)
    draw.text((x + _LEGEND[0], y + _LEGEND[1] + 24), "below 0.5 the inverted map, 1 - m, is better", FAINT, font, "ra")
