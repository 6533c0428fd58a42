"""What an app or another program recorded of a clip: pictures, and the cameras and depth that it knows.

Does not import jax.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import DISTORTED, TURNED, resized_intrinsics
from vggtjax.clips.captures.lens import Lens, Undistortion, undistortion
from vggtjax.clips.captures.pictures import picture_size
from vggtjax.clips.captures.unpacked import Unpacked
from vggtjax.errors import InputError

CaptureKind = Literal["record3d", "polycam", "nerfstudio", "colmap", "tum"]


class OtherShapeError(InputError):
    """A map of another shape than its picture: it does not show what the picture shows."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Pictures in order, and what is known of each of them: OpenCV's axes, pixels of the upright pictures.

    Intrinsics put the outer corner of the first pixel at (0, 0) and its centre at (0.5, 0.5). Raises InputError for
    arrays of another number of frames; the readers have checked the cameras.
    """

    kind: CaptureKind
    path: Path  # the folder, or the file of Record3D
    pictures: tuple[Path, ...] = field(repr=False)
    sizes: tuple[tuple[int, int], ...] = field(repr=False)  # width and height of each picture
    intrinsics: Float64[np.ndarray, "S 3 3"] | None = field(default=None, repr=False)
    world_from_camera: Float64[np.ndarray, "S 4 4"] | None = field(default=None, repr=False)
    lenses: tuple[Lens | None, ...] | None = field(default=None, repr=False)  # with distortion
    has_unknown_lens: bool = False  # it has a distortion of unknown coefficients
    undone: tuple[Undistortion | None, ...] | None = field(default=None, repr=False)  # distortion; see `undistorted`
    metric: bool = False  # poses and depth are in metres, not in a unit of the program's own
    depth_files: tuple[Path | None, ...] | None = field(default=None, repr=False)
    read_depth_file: Callable[[Path], Float32[np.ndarray, "h w"]] | None = field(default=None, repr=False)
    timestamps: Float64[np.ndarray, " S"] | None = field(default=None, repr=False)  # seconds
    absent: tuple[str, ...] = ()  # frames whose picture is not there, of a capture that need not be whole
    left_out: tuple[str, ...] = ()  # a sentence on pictures that are not among these
    notes: tuple[str, ...] = ()  # a sentence for each part that is missing or not as it seems
    archive: Unpacked | None = field(default=None, repr=False)  # keeps the temporary files that `pictures` are, if any

    def __post_init__(self) -> None:
        if not self.pictures:
            raise InputError(f"{self.path} has no picture with a camera; expected at least one")
        shapes = {"intrinsics": (3, 3), "world_from_camera": (4, 4), "timestamps": ()}
        for name, shape in {**shapes, "sizes": (2,)}.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != (len(self), *shape):
                raise InputError(f"{name} of {self.path} have shape {np.shape(value)}; expected {(len(self), *shape)}")
        if self.timestamps is not None and not np.isfinite(self.timestamps).all():
            raise InputError(f"{self.path} has timestamps that are not finite; expected seconds")

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def distorted(self) -> bool:
        """Whether the lens has a distortion, which the intrinsics lack."""
        return self.lenses is not None or self.has_unknown_lens

    def undistorted(self) -> Capture:
        """Return the capture with the sizes, intrinsics and depth of undistorted pictures, where its lenses are known.

        `pictures` are the files as they are; `CaptureFrames` undistorts what it reads of them. Raises InputError for
        coefficients of no lens, and MissingExtraError where there are some and pycolmap is not installed.
        """
        if self.lenses is None or self.intrinsics is None:
            return self
        lenses = zip(self.lenses, self.sizes, strict=True)
        undone = tuple(None if lens is None else undistortion(lens, size, self.path) for lens, size in lenses)
        known = zip(undone, self.sizes, self.intrinsics, strict=True)
        fitted = [(size, K) if made is None else (made.size, made.intrinsics) for made, size, K in known]
        capture = dataclasses.replace(
            self,
            sizes=tuple(size for size, _ in fitted),
            intrinsics=np.stack([K for _, K in fitted]),
            lenses=None,
            undone=undone,
            notes=tuple(note for note in self.notes if note != DISTORTED),
        )
        capture.__dict__["frame_names"] = self.frame_names
        return capture

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """A name for each frame, as `reconstruct` names the frames of this capture: unique in the capture.

        Names are the stems of the files; where two stems are equal, the folders stand before them (cam1_0001).
        """
        stems = [path.stem for path in self.pictures]
        if max(Counter(stems).values()) == 1:
            return tuple(stems)
        parts = [path.with_suffix("").parts for path in self.pictures]
        shared = 0
        while shared < len(parts[0]) and len({part[: shared + 1] for part in parts}) == 1:
            shared += 1
        names = ["_".join(part[shared:]) for part in parts]
        unique = max(Counter(names).values()) == 1
        return tuple(names) if unique else tuple(f"{number:06d}" for number in range(len(names)))

    def for_frames(self, frame_names: Iterable[str]) -> Capture:
        """Return the capture of these frames, in this order; raises InputError for a frame that it lacks."""
        places = {name: place for place, name in enumerate(self.frame_names)}
        names = list(frame_names)
        if missing := [name for name in names if name not in places]:
            raise InputError(
                f"{self.path} has no frame {missing[0]!r}; it has {len(self)} frames, from {self.frame_names[0]!r} to "
                f"{self.frame_names[-1]!r}"
            )
        chosen = [places[name] for name in names]

        def taken(values: Any) -> Any:
            if isinstance(values, tuple):
                return tuple(values[place] for place in chosen)
            return None if values is None else values[chosen]

        fields = (
            "pictures",
            "sizes",
            "intrinsics",
            "world_from_camera",
            "depth_files",
            "timestamps",
            "lenses",
            "undone",
        )
        capture = dataclasses.replace(self, **{name: taken(getattr(self, name)) for name in fields})
        capture.__dict__["frame_names"] = tuple(names)  # of the whole capture, also where fewer would be unique
        return capture

    def naming_files(self) -> AbstractContextManager[None]:
        """Return a context for reading `pictures`: errors in it name the file of Record3D, not where it is unpacked."""
        return nullcontext() if self.archive is None else self.archive.named(self.path)

    def depth(self, frame: int) -> Float32[np.ndarray, "h w"] | None:
        """Return the depth of a frame along z, 0 where it is unknown, or None for a frame without depth.

        It spans the picture, often with fewer pixels; it is in metres if the capture is `metric`, else in the unit of
        the poses. Raises InputError for an unreadable file, OtherShapeError for another shape than the picture's,
        MissingExtraError where a format's library is missing.
        """
        if self.depth_files is None or self.read_depth_file is None or (path := self.depth_files[frame]) is None:
            return None
        with self.naming_files():
            values = self.read_depth_file(path)
            undone = None if self.undone is None else self.undone[frame]
            (width, height), (rows, columns) = self.sizes[frame] if undone is None else undone.stored, values.shape
            if abs(columns * height - rows * width) > max(width, height):  # more than one pixel of rounding
                turned = TURNED if abs(rows * height - columns * width) <= max(width, height) else ""
                raise OtherShapeError(
                    f"{path} has {columns} x {rows} pixels and its picture {width} x {height}; expected the same shape"
                    f"{turned}"
                )
        values = np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)
        return values if undone is None else undone.nearest(values)


def there(pictures: Sequence[Path], source: Path, *, whole: bool) -> tuple[list[int], tuple[str, ...]]:
    """Return the places of the pictures that are there, and the names of the others.

    For a `whole` capture all count as there, and `checked_sizes` refuses a missing one.

    Raises InputError where none is there.
    """
    found = [place for place, path in enumerate(pictures) if whole or path.is_file()]
    if pictures and not found:
        raise InputError(f"{pictures[0]} is missing, and so is every picture that {source} names")
    known = set(found)
    return found, tuple(path.stem for place, path in enumerate(pictures) if place not in known)


def checked_sizes(pictures: Sequence[Path], source: Path) -> tuple[tuple[int, int], ...]:
    """Return width and height of pictures; raises InputError for a missing one, which `source` names."""
    for path in pictures:
        if not path.is_file():
            raise InputError(f"{path} is missing, but {source} names it; get the capture whole")
    return tuple(picture_size(path, with_camera=True) for path in pictures)


def fitted_intrinsics(
    intrinsics: Sequence[Float64[np.ndarray, "3 3"]],
    camera_sizes: Sequence[tuple[int, int]],
    sizes: Sequence[tuple[int, int]],
    source: Path,
) -> Float64[np.ndarray, "S 3 3"]:
    """Return intrinsics of cameras of (width, height) at the pictures' sizes; raises InputError for another shape."""
    cameras = zip(intrinsics, camera_sizes, sizes, strict=True)
    return np.stack([resized_intrinsics(matrix, size, picture, source) for matrix, size, picture in cameras])


def lenses_of(lenses: Iterable[Lens | None]) -> tuple[Lens | None, ...] | None:
    """Return the lenses of pictures, or None where none has a distortion."""
    found = tuple(lenses)
    return found if any(found) else None


def left_out(missing: Sequence[str], count: int, what: str) -> tuple[str, ...]:
    """Return a note on pictures that a capture leaves out because they lack something; none if there are none."""
    if not missing:
        return ()
    return (f"{len(missing)} of {count} pictures have no {what} and are left out, {missing[0]} first",)
