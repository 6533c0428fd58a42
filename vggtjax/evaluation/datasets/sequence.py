"""A sequence of a data set: its pictures, which of them a protocol takes, and the ground truth at their own pixels.

Does not import jax.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped

from vggtjax.captures.cameras import TURNED
from vggtjax.captures.pictures import PNG, opening, picture_size
from vggtjax.errors import InputError
from vggtjax.media.sampling import Sampling

T = TypeVar("T")
DepthReader = Callable[[int], Float32[np.ndarray, "h w"]]
MaskReader = Callable[[int], Bool[np.ndarray, "h w"]]


class FrameChoice(NamedTuple):
    """A window of frames, of which every `stride`-th is taken, and at most `most`."""

    window: slice = slice(None)
    stride: int = 1
    most: int | None = None

    def sampled(self, sampling: Sampling) -> FrameChoice:
        """Return the frames of `sampling` within the window; its stride, if any, replaces this stride."""
        window = slice((self.window.start or 0) + sampling.start, self.window.stop)
        stride = self.stride if sampling.stride is None else sampling.stride
        mosts = [most for most in (self.most, sampling.max_frames) if most is not None]
        return FrameChoice(window if sampling.start else self.window, stride, min(mosts, default=None))

    def of(self, items: Sequence[T], name: str) -> list[T]:
        """Return the chosen items, one for each frame of the sequence `name`; raises InputError if there is none."""
        if not items:
            raise InputError(f"sequence {name} has no frames; expected at least one")
        chosen = list(items[self.window][:: self.stride][: self.most])
        if not chosen:
            raise InputError(f"sequence {name} has {len(items)} frames, none of them from frame {self.window.start} on")
        return chosen

    def shortage(self, count: int) -> tuple[str, ...]:
        """Return a note if a sequence of `count` frames ends before the window."""
        if self.window.stop is None or count >= self.window.stop:
            return ()
        return (f"it has {count} frames; the protocol takes {self.window.start or 0} to {self.window.stop - 1}",)


EVERY_FRAME = FrameChoice()


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


def depth_reader(
    pictures: Sequence[Path],
    paths: Sequence[Path | None],
    read: Callable[[Path], Float32[np.ndarray, "h w"]],
    expected: Path,
) -> tuple[DepthReader | None, tuple[str, ...]]:
    """Return a reader of the frames' depth, 0 where it is unknown, and notes on frames without depth.

    The notes say where the depth is `expected`.

    The reader is None if no frame has depth. It raises InputError for unreadable files and for maps of another size
    than their picture. Depth that is not finite or not above 0 counts as unknown.
    """
    missing = [picture.stem for picture, path in zip(pictures, paths, strict=True) if path is None]
    if len(missing) == len(pictures):
        return None, (f"it has no depth; expected {expected}",)

    def depth(frame: int) -> Float32[np.ndarray, "h w"]:
        path = paths[frame]
        if path is None:
            width, height = picture_size(pictures[frame])
            return np.zeros((height, width), np.float32)
        values = _of_picture_size(read(path), path, pictures[frame])
        return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)

    if not missing:
        return depth, ()
    return depth, (f"{len(missing)} of {len(pictures)} frames have no depth, {missing[0]} first; expected {expected}",)


def mask_reader(
    pictures: Sequence[Path],
    paths: Sequence[Path | None],
    read: Callable[[Path], Bool[np.ndarray, "h w"]],
    expected: Path,
) -> tuple[MaskReader | None, tuple[str, ...]]:
    """Return a reader of the frames' masks, or None and a note unless every frame has a mask, `expected` there."""
    masks = [path for path in paths if path is not None]
    if len(masks) < len(pictures):
        count = f"{len(masks) or 'none'} of {len(pictures)}"
        return None, (f"{count} frames have a mask, so it has no masks; expected {expected}",)
    return lambda frame: _of_picture_size(read(masks[frame]), masks[frame], pictures[frame]), ()


def read_labels(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read a picture of labels (palette, brightness or colour): True where a label is above 0.

    Raises InputError for any other file.
    """
    with opening(path, PNG) as image:
        labels = np.asarray(image)
        mode = image.mode
    if mode in ("LA", "RGBA"):
        labels = labels[..., :-1]  # without opacity
    above = np.asarray(labels > 0)
    return above if above.ndim == 2 else np.asarray(above.any(axis=2))


def _of_picture_size(values: Shaped[np.ndarray, "h w"], path: Path, picture: Path) -> Shaped[np.ndarray, "h w"]:
    width, height = picture_size(picture)
    if values.shape != (height, width):
        turned = TURNED if values.shape == (width, height) else ""
        raise InputError(
            f"{path} has shape {values.shape}; expected {(height, width)}, the size of {picture.name}{turned}"
        )
    return values
