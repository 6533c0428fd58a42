"""A sequence of a data set: its pictures, and their ground truth at the pictures' own pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.frames import FrameChoice

DepthReader = Callable[[int], Float32[np.ndarray, "h w"]]
MaskReader = Callable[[int], Bool[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class LabelledSequence:
    """Frames in order, and the ground truth that the data set has: metres, seconds, OpenCV's axes.

    Depth and masks are read at each use, by the frame's index. Intrinsics put the outer corner of the first pixel at
    (0, 0) and its centre at (0.5, 0.5); readers shift the intrinsics of data sets that count from the centre.
    """

    name: str
    pictures: tuple[Path, ...]
    depth: DepthReader | None = None  # along z, 0 where it is unknown; at the pictures' size
    mask: MaskReader | None = None  # True where the world moves; at the pictures' size
    world_from_camera: Float64[np.ndarray, "S 4 4"] | None = None
    intrinsics: Float64[np.ndarray, "S 3 3"] | None = None
    timestamps: Float64[np.ndarray, " S"] | None = None
    notes: tuple[str, ...] = ()  # a sentence for each missing or skipped part
    frame_names: tuple[str, ...] = ()  # the pictures' names without endings by default
    archive: object | None = None  # keeps the temporary files that `pictures` are, if any

    def __post_init__(self) -> None:
        if not self.pictures:
            raise InputError(f"sequence {self.name} has no frames; expected at least one")
        if not self.frame_names:
            object.__setattr__(self, "frame_names", tuple(path.stem for path in self.pictures))
        for name, shape in (
            ("world_from_camera", (4, 4)),
            ("intrinsics", (3, 3)),
            ("timestamps", ()),
            ("frame_names", ()),
        ):
            value = getattr(self, name)
            if value is not None and np.shape(value) != (len(self), *shape):
                raise InputError(f"{name} of {self.name} has shape {np.shape(value)}; expected {(len(self), *shape)}")

    def __len__(self) -> int:
        return len(self.pictures)


Opener = Callable[[FrameChoice], LabelledSequence]
Reader = Callable[..., Mapping[str, Opener]]  # of a root, and of a ground truth where a data set has several
