"""What every exporter writes of a frame: its picture, its camera and its maps, under a file name that is safe."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from vggtjax.cameras import world_from_camera
from vggtjax.errors import ClipError, InputError
from vggtjax.media.images import ImageFiles
from vggtjax.media.sampling import Sampling, Source
from vggtjax.results.frame import ResultFrame, frame_of
from vggtjax.results.result import Result

_SAFE = re.compile(r"\w[\w. -]{0,99}", re.ASCII)
_WRITTEN = (".jpg", ".jpeg", ".png")  # as which pictures are written


class View(NamedTuple):
    """A frame of the clip as an exporter writes it."""

    name: str  # of the picture's file; unique in the clip
    time: float  # seconds; the frame's number where times are unknown
    frame: ResultFrame
    has_mask: bool = True  # which tells what moves

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the picture."""
        return self.frame.depth.shape[0], self.frame.depth.shape[1]

    @property
    def camera_from_world(self) -> Float64[np.ndarray, "3 4"]:
        """The pose with a rotation that is one to float64."""
        return rigid(self.frame.camera_from_world)

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"]:
        """The inverse of `camera_from_world`."""
        return world_from_camera(self.camera_from_world[None])[0]

    @property
    def static(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that the model saw and that do not move."""
        return self.frame.seen & ~self.frame.dynamic_mask

    def write_picture(self, folder: Path) -> None:
        """Write the picture under its name: .jpg with little loss, .png with none."""
        Image.fromarray(self.frame.image).save(folder / self.name, quality=95, compress_level=3)


def rigid(camera_from_world: np.ndarray) -> Float64[np.ndarray, "3 4"]:
    """Return a pose in float64 whose rotation is the nearest one."""
    pose = camera_from_world.astype(np.float64)
    return np.column_stack([Rotation.from_matrix(pose[:, :3]).as_matrix(), pose[:, 3]])


def views(result: Result, source: Source | None) -> Iterator[View]:
    """Yield the frames at the model's size, or with a `source` at the size of its pictures, one in memory at a time.

    Raises ClipError where the source lacks a frame of the result, or has a picture of another size.
    """
    times = range(len(result.depth)) if result.timestamps is None else result.timestamps
    names = view_names(result, source)
    if source is None:
        for number, (name, time) in enumerate(zip(names, times, strict=True)):
            yield View(name, float(time), frame_of(result, number), result.has_mask)
        return
    for number, picture in enumerate(_pictures(result, source)):
        frame = frame_of(result, number, "original", picture=picture)
        yield View(names[number], float(times[number]), frame, result.has_mask)


def of_one_size(items: Iterator[View], what: str) -> Iterator[View]:
    """Yield the frames. Raises InputError for a frame of another size than the first, as `what` has one."""
    size = None
    for number, view in enumerate(items, start=1):
        size = size or view.size
        if view.size != size:
            raise InputError(
                f"frame {number} has {view.size[1]} x {view.size[0]} pixels and the first {size[1]} x {size[0]}; "
                f"{what} has one size: leave out the pictures, to write them at the model's size"
            )
        yield view


def view_names(result: Result, source: Source | None) -> list[str]:
    """Return the names of the pictures' files.

    They are the names of the source's files where these are .jpg or .png, else the frames' names and a suffix: .jpg for
    frames of a video, .png at the model's size. Names that are unsafe or not unique give way to the frames' numbers.
    """
    suffix = ".png" if source is None else ".jpg"
    names = [f"{name}{suffix}" for name in result.frame_names]
    if isinstance(source, ImageFiles):
        pictures = zip(source.frame_names, source.paths, strict=True)
        files = {name: path.name for name, path in pictures if path.suffix.lower() in _WRITTEN}
        names = [files.get(stem, name) for stem, name in zip(result.frame_names, names, strict=True)]
    if len({name.casefold() for name in names}) == len(names) and all(_SAFE.fullmatch(name) for name in names):
        return names
    return [f"{number:06d}{suffix}" for number in range(len(names))]


def _pictures(result: Result, source: Source) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the source's pictures of the result's frames, which come in the same order."""
    frames = source.frames(Sampling())
    for number, name in enumerate(result.frame_names):
        frame = next((frame for frame in frames if frame.name == name), None)
        if frame is None:
            raise ClipError(f"the pictures have no frame {name!r}; name the source that the result was made from")
        height, width = result.source_size[number]
        if frame.image.size != (width, height):
            size = "{} x {}".format(*frame.image.size)
            raise ClipError(f"frame {name!r} has {size} pixels; the result was made from {width} x {height}")
        yield np.asarray(frame.image)
