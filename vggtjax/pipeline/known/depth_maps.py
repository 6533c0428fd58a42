"""A folder of metric depth maps, of a depth model or a lidar, at the pixels of a clip. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import TURNED
from vggtjax.clips.captures.depth_files import read_exr, read_npy, read_npz, read_png
from vggtjax.clips.captures.files import files
from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.captures.lens import Undistortion
from vggtjax.clips.clip import Clip
from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError
from vggtjax.results.result import Result

_PER_METRE = 1000.0

# Readers by the ends of names; of a folder with several kinds, such as maps and pictures of them, the first is taken.
_READERS: dict[str, Callable[[Path, float], Float32[np.ndarray, "h w"]]] = {
    ".npz": read_npz,
    ".npy": read_npy,
    ".exr": lambda path, _: read_exr(path),
    ".png": read_png,
}


def depth_files(folder: Path) -> list[Path]:
    """Return the depth maps of a folder in natural order; raises InputError where there are none."""
    there = files(folder, "").values()
    for ending in _READERS:
        if found := [path for path in there if path.suffix.lower() == ending]:
            return in_order(found)
    raise InputError(f"{folder} has no depth maps; expected {', '.join(_READERS)}, named like the frames")


def read_depth_maps(
    folder: Path, frames: Clip | Result, per_metre: float | None = None
) -> Float32[np.ndarray, "S H W"]:
    """Return the depth maps of a folder at the pixels of the frames: metres, 0 where it is unknown.

    Every pixel takes the value at the place in the source that its centre shows; values are never mixed. Maps have any
    size of the shape of the source's pictures, and those of a capture whose frames are undistorted may be of the
    pictures as they are.

    Args:
        folder: a map for each frame, or for some, named like it (`frame_3.npz` for `frame_3.jpg`); or, if none is named
            like a frame, as many maps as frames, in their order.
        frames: the clip, or its result.
        per_metre: steps of whole numbers to the metre; 1000 by default.

    Raises InputError for no maps, other numbers or shapes of them, unreadable files, and maps that know nothing.
    """
    names, found = list(frames.frame_names), depth_files(folder)
    by_name = {path.stem: path for path in found}
    paths = [by_name.get(name) for name in names]
    if not any(paths):
        if len(found) != len(names):
            raise InputError(
                f"{folder} has {len(found)} depth maps for {len(names)} frames, and none is named like a frame, such "
                f"as {names[0]}; expected names of frames, or a map for each"
            )
        paths = found
    maps = np.zeros(frames.images.shape[:3], np.float32)
    for frame, path in enumerate(paths):
        if path is not None:
            _fill(maps[frame], _READERS[path.suffix.lower()](path, per_metre or _PER_METRE), path, frames, frame)
    if not maps.any():
        raise InputError(f"{folder} has maps without a known depth; expected finite metres above 0")
    return maps


def _fill(
    target: Float32[np.ndarray, "H W"],
    values: Float32[np.ndarray, "h w"],
    path: Path,
    frames: Clip | Result,
    frame: int,
) -> None:
    """Write a map of the source's picture to the pixels of a frame."""
    height, width = frames.source_size[frame].tolist()
    size = values.shape[::-1]
    undone = _undistortion(frames, frame)
    left, top, right, bottom = frames.valid_box[frame].tolist()
    pixels = np.stack(np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5), axis=-1)
    places: Float64[np.ndarray, "h w 2"] = pixels * frames.source_scale[frame] + frames.source_offset[frame]
    if undone is not None and undone.is_stored(size):
        places, (width, height) = undone.stored_points(places), undone.stored
    if abs(size[0] * height - size[1] * width) > max(*size, width, height):  # more than one pixel of rounding
        across = abs(size[0] * width - size[1] * height) <= max(*size, width, height)
        raise InputError(
            f"{path} has {size[0]} x {size[1]} pixels and its picture {width} x {height}; expected the same shape"
            f"{TURNED if across else ''}"
        )
    x, y = (np.clip(places[..., axis] / (width, height)[axis] * size[axis], 0, size[axis] - 1) for axis in (0, 1))
    known = values[y.astype(int), x.astype(int)]
    target[top:bottom, left:right] = np.where(np.isfinite(known) & (known > 0), known, 0)


def _undistortion(frames: Clip | Result, frame: int) -> Undistortion | None:
    if not isinstance(frames, Clip) or not isinstance(frames.source, CaptureFrames):
        return None
    return frames.source.undistortion(frames.frame_names[frame])
