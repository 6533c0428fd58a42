"""A grid of labelled pictures on a dark ground, as all sheets of this package are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

BACKGROUND, TEXT, FAINT = (20, 20, 24), (236, 236, 240), (150, 150, 160)
MARGIN, GAP = 24, 6
_TITLE_WIDTH = 700  # least pixels of a sheet with a title
_LABEL_WIDTH, _LINE = 150, 18


class Row(NamedTuple):
    """Pictures beside each other.

    Attributes:
        label: what they show.
        pictures: [h, w, 3] each, of any size.
        notes: lines below the label.
        ramp: the colours of values, and words for the lowest and the highest.
    """

    label: str
    pictures: Sequence[UInt8[np.ndarray, "h w 3"]]
    notes: str = ""
    ramp: tuple[UInt8[np.ndarray, "256 3"], str, str] | None = None


def fitted(shape: tuple[int, int], most: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of pictures of this height and width, as large as `most` (width, height) allows."""
    scale = min(most[0] / shape[1], most[1] / shape[0])
    return max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale))


def draw_grid(
    title: str, columns: Sequence[str], rows: Sequence[Row], size: tuple[int, int], notes: str = ""
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw rows of pictures of `size` (width, height) below a title, notes, and the labels of the columns."""
    large, small = ImageFont.load_default(22), ImageFont.load_default(15)
    left = MARGIN + (_LABEL_WIDTH if any(row.label for row in rows) else 0)
    top = MARGIN + 30 + _LINE * (notes.count("\n") + 1 if notes else 0) + 26
    step_x, step_y = size[0] + GAP, size[1] + GAP
    right = max(left + len(columns) * step_x - GAP, _TITLE_WIDTH)
    sheet = Image.new("RGB", (right + MARGIN, top + len(rows) * step_y - GAP + MARGIN), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), title, TEXT, large)
    draw.text((MARGIN, MARGIN + 30), notes, FAINT, small, spacing=4)
    for x, name in zip(range(left, right, step_x), columns, strict=False):
        draw.text((x, top - 22), name, FAINT, small)
    for number, row in enumerate(rows):
        y = top + number * step_y
        draw.text((MARGIN, y), row.label, TEXT, small)
        draw.text((MARGIN, y + 22), row.notes, FAINT, small)
        if row.ramp is not None:
            colors, lowest, highest = row.ramp
            width = _LABEL_WIDTH - 30
            sheet.paste(Image.fromarray(colors[None]).resize((width, 10)), (MARGIN, y + 24))
            draw.text((MARGIN, y + 38), lowest, FAINT, small)
            draw.text((MARGIN + width, y + 38), highest, FAINT, small, "ra")
        for column, picture in enumerate(row.pictures):
            thumbnail = Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS)
            sheet.paste(thumbnail, (left + column * step_x, y))
    return np.asarray(sheet)
