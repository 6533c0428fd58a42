"""Known depths at pixels of a clip: from a CSV file, or from the maps of a capture. Does not import jax."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from vggtjax.clips.captures.capture import Capture
from vggtjax.clips.truth import Placed
from vggtjax.errors import InputError, one_line
from vggtjax.results.result import Result
from vggtjax.storage.csv_file import read_csv

MOST_FILE_BYTES = 1 << 24
_FRAME_DEPTHS = 10_000  # of a map


class DepthSamples(NamedTuple):
    """Known depths at pixels of frames."""

    frames: Int64[np.ndarray, " N"]
    rows: Int64[np.ndarray, " N"]
    columns: Int64[np.ndarray, " N"]
    depth: Float64[np.ndarray, " N"]  # metres


def read_depths(path: str | Path, frames: Placed) -> DepthSamples:
    """Read a CSV file with columns frame, x, y and depth: pixels of the source's pictures, and metres.

    Raises InputError for an unreadable file, other columns, no rows, and points outside the frames that the model saw.
    """
    path = Path(path)
    found = []
    count = len(frames.images)
    for number, line in read_csv(path, most_bytes=MOST_FILE_BYTES).rows:
        shown = one_line(str(line))
        try:
            frame, x, y, depth = int(line["frame"]), float(line["x"]), float(line["y"]), float(line["depth"])
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path} line {number} is {shown}; expected columns frame, x, y and depth") from None
        if not 0 <= frame < count or not (0 < depth < np.inf and np.isfinite([x, y]).all()):
            raise InputError(f"{path} line {number} is {shown}; expected a frame of 0 to {count - 1} and depth above 0")
        place = (np.array([x, y]) - frames.source_offset[frame]) / frames.source_scale[frame]
        column, row = np.floor(place).astype(int).tolist()
        left, top, right, bottom = frames.valid_box[frame].tolist()
        if not (left <= column < right and top <= row < bottom):
            height, width = frames.source_size[frame].tolist()
            raise InputError(
                f"{path} line {number}: ({x:g}, {y:g}) lies outside what the model sees of frame {frame}, a picture of "
                f"{width} x {height} pixels; expected a place inside"
            )
        found.append((frame, row, column, depth))
    if not found:
        raise InputError(f"{path} holds no depths; expected a line frame,x,y,depth and then one line per point")
    numbers, rows, columns, depths = np.array(found, np.float64).T
    return DepthSamples(numbers.astype(int), rows.astype(int), columns.astype(int), depths)


def check_depths(capture: Capture) -> None:
    """Read the depth maps of a capture; raises what `Capture.depth` raises, and InputError where it has no depth."""
    maps = [capture.depth(frame) is not None for frame in range(len(capture))]
    if not any(maps):
        raise InputError(f"{capture.path} has no depth maps for these frames; give known depths as a file")


def sampled_depths(maps: Float32[np.ndarray, "S H W"], result: Result, name: str) -> DepthSamples:
    """Return depth maps at the result's pixels at up to 10000 valid static ones of each frame.

    Raises InputError, which says `name`, where the maps know no depth there.
    """
    usable = result.valid_pixels & ~result.dynamic_mask & (maps > 0)
    found = []
    for frame, places in enumerate(usable):
        rows, columns = _sampled(places)
        found.append(np.stack([np.full(len(rows), frame), rows, columns]))
    frames, rows, columns = np.concatenate(found, axis=1)
    if not len(frames):
        raise InputError(f"the depth maps of {name} know nothing of the static pixels; give others, or a baseline")
    return DepthSamples(frames, rows, columns, maps[frames, rows, columns].astype(np.float64))


def captured_depths(capture: Capture, result: Result) -> DepthSamples:
    """Return the depth maps of a capture at up to 10000 valid static pixels of each frame.

    Raises InputError where the maps know no depth there.
    """
    found = []
    usable = result.valid_pixels & ~result.dynamic_mask
    for frame in range(len(result.depth)):
        if (depth := capture.depth(frame)) is None:
            continue
        rows, columns = _sampled(usable[frame])
        places = np.column_stack([columns, rows]) + 0.5
        shares = (places * result.source_scale[frame] + result.source_offset[frame]) / result.source_size[frame][::-1]
        x, y = (np.clip(shares[:, axis] * depth.shape[1 - axis], 0, depth.shape[1 - axis] - 1) for axis in (0, 1))
        values = depth[y.astype(int), x.astype(int)].astype(np.float64)
        known = values > 0
        found.append(np.column_stack([np.full(len(rows), frame), rows, columns, values])[known])
    if not sum(map(len, found)):
        raise InputError(
            f"the depth maps of {capture.path} know nothing of the static pixels; give known depths as a file"
        )
    frames, rows, columns, depths = np.concatenate(found).T
    return DepthSamples(frames.astype(int), rows.astype(int), columns.astype(int), depths)


def _sampled(places: Bool[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of at most `_FRAME_DEPTHS` true pixels, evenly spread."""
    rows, columns = np.nonzero(places)
    step = max(1, -(-len(rows) // _FRAME_DEPTHS))
    return rows[::step], columns[::step]
