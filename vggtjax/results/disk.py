"""What a result takes on the disk, told before it is written."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Int
from rich.filesize import decimal

from vggtjax.errors import OutputError
from vggtjax.results.previews import enlarged
from vggtjax.results.saving import Group, Saving

LARGE = 1e9  # bytes; larger results are announced
_ARCHIVE = 10.0  # bytes of a pixel at the model's size, compressed: pictures, depth, confidence
_POINT = 16  # bytes of a point
_MOST_SCENE = 25e6  # bytes: a scene has a limit of points
_MOST_REPORT = 2e6  # bytes: a report shows a few frames and a short film
_VGGT4D = 10.5  # bytes of a pixel: depth, confidence, picture
_PIXEL: dict[Group, float] = {"depth": 5.5, "confidence": 4.0, "masks": 0.1}  # bytes of a written pixel
_PREVIEW = 3.0  # bytes of a pixel of the previews: coloured depth and overlay, compressed

logger = logging.getLogger(__name__)


def forecast_bytes(shape: tuple[int, int, int], source_size: Int[np.ndarray, "S 2"], saving: Saving) -> float:
    """Return about how many bytes the files of a result will take: within a factor of two.

    Args:
        shape: frames, height and width at the model's size.
        source_size: heights and widths of the source's pictures, for the resolution "original".
        saving: which files are written, and at which size.
    """
    frames, height, width = shape
    at_model = frames * height * width
    original = saving.resolution == "original"
    pixels = float(source_size.prod(axis=1, dtype=np.float64).sum()) if original else float(at_model)
    points = (1 - saving.confidence_percentile / 100) * pixels
    total = _ARCHIVE * at_model + sum(rate * pixels for group, rate in _PIXEL.items() if saving.writes(group))
    if saving.writes("clouds"):
        total += 2 * _POINT * points  # each frame's, and the static ones of all frames
    if saving.writes("scene"):
        total += min(_POINT * points, _MOST_SCENE)
    if saving.writes("report"):
        total += min(at_model, _MOST_REPORT)
    if saving.writes("previews"):
        sides = source_size if original else np.tile([height, width], (frames, 1))
        total += _PREVIEW * sum(float(np.prod(enlarged(tuple(side)), dtype=np.float64)) for side in sides.tolist())
    return total + (_VGGT4D * pixels if saving.format == "vggt4d" else 0)


def check_space(folder: str | Path, needed: float) -> int | None:
    """Return the free bytes of the disk of `folder`, which may be missing; None where the system does not tell.

    Raises OutputError where it has less than `needed`. An earlier result in the folder goes only when the new one is
    whole, so its space does not count.
    """
    place = Path(folder).absolute()
    try:
        free = shutil.disk_usage(next(path for path in (place, *place.parents) if path.exists())).free
    except OSError:
        return None
    if needed > free:
        raise OutputError(
            f"the result takes about {decimal(round(needed))} and the disk of {folder} has {decimal(free)} left; "
            "free some, choose another folder, or write less: --only depth,cameras, --resolution model"
        )
    return free


def announce(folder: str | Path, needed: float) -> None:
    """Check the space and, where much is needed, log how much."""
    free = check_space(folder, needed)
    if needed > LARGE:
        left = "" if free is None else f"; the disk has {decimal(free)} left"
        logger.info("the result in %s will take about %s%s", folder, decimal(round(needed)), left)
