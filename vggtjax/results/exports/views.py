"""What every exporter writes of a frame: its picture, its camera and its maps, under a file name that is safe."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from vggtjax.cameras import world_from_camera
from vggtjax.clips.media.sampling import Sampling, Source
from vggtjax.errors import ClipError, InputError
from vggtjax.results.frame import ResultFrame, frame_of
from vggtjax.results.result import Result


class View(NamedTuple):
    """A frame of the clip as an exporter writes it."""

    name: str  # of the picture's file, with / between folders; unique in the clip
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

    @property
    def needs_mask(self) -> bool:
        """Whether `static` tells anything: what moves, or what the model did not see."""
        return self.has_mask or not self.frame.seen.all()

    def write_picture(self, folder: Path) -> None:
        """Write the picture under its name: .jpg with little loss, .png with none."""
        Image.fromarray(self.frame.image).save(placed(folder, self.name), quality=95, compress_level=3)


def placed(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder; make the folders in between."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def rigid(camera_from_world: np.ndarray) -> Float64[np.ndarray, "3 4"]:
    """Return a pose in float64 whose rotation is the nearest one."""
    pose = camera_from_world.astype(np.float64)
    return np.column_stack([Rotation.from_matrix(pose[:, :3]).as_matrix(), pose[:, 3]])


def views(result: Result, source: Source | None, names: Sequence[str]) -> Iterator[View]:
    """Yield the frames by these names, one in memory at a time: at the model's size, or at that of a source's pictures.

    Raises ClipError where the source lacks a frame of the result, or has a picture of another size.
    """
    times = range(len(result.depth)) if result.timestamps is None else result.timestamps
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
