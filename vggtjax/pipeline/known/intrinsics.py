"""Known intrinsics: read, checked against the pictures, and carried to the pixels of a clip. Does not import jax."""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.media.focal import FOCAL_RANGE
from vggtjax.clips.truth import Placed, intrinsics_at_clip_pixels
from vggtjax.errors import InputError, one_line
from vggtjax.pipeline.known.options import EXIF, SOURCE, KnownGeometry
from vggtjax.results.result import Result
from vggtjax.storage.trajectories import read_numbers

_MOST_SKEW = 1e-3  # of the focal length
_OFF_CENTRE, _FAR_OFF = 0.2, 0.45  # of the picture's sides from its middle: warned about, and refused

logger = logging.getLogger(__name__)


def read_intrinsics(text: str) -> Float64[np.ndarray, "F 3 3"]:
    """Return the intrinsics that words name, one matrix for all frames or one for each.

    Args:
        text: `fx,fy,cx,cy`, or the path of a file: a 3 x 3 matrix, or lines of fx fy cx cy, or of the nine numbers of a
            matrix, row by row.

    Raises InputError or ResultError for other words and unreadable files.
    """
    if not os.path.isfile(text):  # noqa: PTH113 - False for an over-long name
        try:
            numbers = [float(word) for word in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != 4 or not np.isfinite(numbers).all():
            raise InputError(
                f"intrinsics is {one_line(text)!r}; expected fx,fy,cx,cy, four numbers in pixels, 'source', 'exif', or "
                "a file that is there"
            )
        return _matrices(np.array([numbers]))
    rows = read_numbers(text, (3, 4, 9))
    if rows.shape[1] == 4:
        return _matrices(rows)
    if rows.size % 9:
        raise InputError(f"{text} has {len(rows)} rows of 3 numbers; expected a matrix of 3 x 3")
    return rows.reshape(-1, 3, 3)


def known_values(known: KnownGeometry) -> dict[str, Any]:
    """Return what is given, as JSON values, with the intrinsics of a file as numbers: the file may change."""
    values = known.to_json()
    if known.intrinsics not in (None, SOURCE, EXIF):
        values["intrinsics"] = read_intrinsics(known.intrinsics).tolist()
    return values


def at_clip_pixels(intrinsics: Float64[np.ndarray, "F 3 3"], clip: Placed, name: str) -> Float64[np.ndarray, "S 3 3"]:
    """Return intrinsics of the source's pictures in pixels of the clip.

    Raises InputError, which names the intrinsics by `name`, for another number of matrices than one or one per frame,
    skew, or focal lengths and principal points that do not fit the source's pictures.
    """
    frames = len(clip.images)
    if len(intrinsics) not in (1, frames):
        raise InputError(f"{name} has {len(intrinsics)} sets of intrinsics; expected 1, or {frames}, one per frame")
    K = np.broadcast_to(intrinsics, (frames, 3, 3))
    for frame, (matrix, (height, width)) in enumerate(zip(K, clip.source_size.tolist(), strict=True)):
        (fx, skew, cx), (_, fy, cy) = matrix[0].tolist(), matrix[1].tolist()
        shown = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} for frame {frame} of {width} x {height} pixels"
        if abs(skew) > _MOST_SKEW * abs(fx) or not np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
            raise InputError(f"{name} is no matrix of a pinhole camera without skew; expected fx 0 cx, 0 fy cy, 0 0 1")
        if not (abs(cx / width - 0.5) < _FAR_OFF and abs(cy / height - 0.5) < _FAR_OFF):
            raise InputError(
                f"{name} has {shown}: the principal point lies at the border of the picture or outside; expected "
                "intrinsics in pixels of these pictures, so scale those of another size"
            )
        low, high = (share * max(width, height) for share in FOCAL_RANGE)
        if not (low <= fx <= high and low <= fy <= high):
            raise InputError(f"{name} has {shown}; expected focal lengths of {low:g} to {high:g} pixels")
    share = K[:, :2, 2] / clip.source_size[:, ::-1]
    if (np.abs(share - 0.5) > _OFF_CENTRE).all():
        height, width = clip.source_size[0].tolist()
        logger.warning(
            "the principal point of %s, (%g, %g), is far from the middle of the pictures of %d x %d pixels; are the "
            "intrinsics those of another size?", name, *K[0, :2, 2], width, height,
        )  # fmt: skip
    return intrinsics_at_clip_pixels(clip, K)


def shared_focal(result: Result) -> Float64[np.ndarray, "S 3 3"]:
    """Return intrinsics with one focal length, in pixels of the source: the median of the predicted ones.

    The source's pixels are taken to be square. Principal points stay.
    """
    scale = result.source_scale / np.exp(np.log(result.source_scale).mean())  # pictures of several sizes show one view
    K = result.intrinsics.astype(np.float64)
    focal = np.exp(np.median(np.log(K[:, [0, 1], [0, 1]] * scale)))
    K[:, [0, 1], [0, 1]] = focal / scale
    return K


def _matrices(rows: Float64[np.ndarray, "F 4"]) -> Float64[np.ndarray, "F 3 3"]:
    K = np.tile(np.eye(3), (len(rows), 1, 1))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = rows.T
    return K
