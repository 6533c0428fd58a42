"""A sequence of a data set: its pictures, which of them a protocol takes, and the ground truth at their own pixels.

Does not import jax.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped

from vggtjax.clips.captures.cameras import TURNED
from vggtjax.clips.captures.capture import OtherShapeError
from vggtjax.clips.captures.pictures import PNG, opening, picture_size
from vggtjax.clips.media.order import in_order
from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError, one_line
from vggtjax.research.evaluation.datasets.frames_list import Pinned
from vggtjax.research.evaluation.datasets.true_tracks import TrueTracks

T = TypeVar("T")
DepthReader = Callable[[int], Float32[np.ndarray, "h w"]]
MaskReader = Callable[[int], Bool[np.ndarray, "h w"] | None]
_MOST_NAMES = 5  # of frames in a sentence
_SAME_SHAPE = 0.02  # by which the shapes of a picture and its map may differ, as ScanNet's do


class LeftOut(NamedTuple):
    """Frames of a sequence that are not scored, or not by one kind of truth."""

    what: str  # of "poses", "depth", "masks", "pictures", "results"
    frames: tuple[str, ...]
    total: int  # of frames
    why: str  # what they lack: "have no depth"
    expected: str = ""  # where it is expected
    usual: bool = False  # a published protocol leaves them out, too

    @property
    def sentence(self) -> str:
        """Counts and names in words."""
        names = ", ".join(one_line(name, 60) for name in self.frames[:_MOST_NAMES])
        more = f" and {len(self.frames) - _MOST_NAMES} more" if len(self.frames) > _MOST_NAMES else ""
        expected = f"; expected {self.expected}" if self.expected else ""
        return f"{len(self.frames)} of {self.total} frames {self.why}: {names}{more}{expected}"

    def to_json(self) -> dict[str, Any]:
        """Return counts and the first names as JSON values."""
        return {"count": len(self.frames), "of": self.total, "why": self.why, "frames": [*self.frames[:_MOST_NAMES]]}


def left_out(
    what: str, frames: Sequence[str], total: int, why: str, expected: Path | str = "", *, usual: bool = False
) -> tuple[LeftOut, ...]:
    """Return what is left out as a tuple of one; empty where no frame is."""
    return (LeftOut(what, tuple(frames), total, why, str(expected), usual),) if frames else ()


class FrameChoice(NamedTuple):
    """A window of frames, of which every `stride`-th is taken unless it is left out, and at most `most`.

    `pinned` frames are taken in place of all that.
    """

    window: slice = slice(None)
    stride: int = 1
    most: int | None = None
    takes: Callable[[int], bool] = lambda frame: True  # by its number in the sequence
    pinned: Pinned | None = None

    def sampled(self, sampling: Sampling) -> FrameChoice:
        """Return the frames of `sampling` within the window; its stride, if any, replaces this stride.

        Its `start` and `skip` count from the start of the window.
        """
        first = self.window.start or 0
        window = slice(first + sampling.start, self.window.stop)
        stride = self.stride if sampling.stride is None else sampling.stride
        mosts = [most for most in (self.most, sampling.max_frames) if most is not None]
        takes = self.takes if sampling.skip is None else lambda frame: sampling.takes(frame - first)
        return FrameChoice(window if sampling.start else self.window, stride, min(mosts, default=None), takes)

    def of(self, items: Sequence[T], name: str, pictures: Sequence[Path] = ()) -> list[T]:
        """Return the chosen items, one for each frame of the sequence `name`; raises InputError if there is none.

        Pinned frames are named by the items, or by the pictures where the items have no names.
        """
        if not items:
            raise InputError(f"sequence {name} has no frames; expected at least one")
        if self.pinned is not None:
            names = [item.stem if isinstance(item, Path) else str(item) for item in pictures or items]
            return [items[place] for place in self.pinned.places(names, name)]
        count = len(items[self.window][:: self.stride])
        if not count:
            raise InputError(f"sequence {name} has {len(items)} frames, none of them from frame {self.window.start} on")
        if not (chosen := self.inside(items)):
            raise InputError(f"skip leaves none of {count} frames of sequence {name}; expected to leave one")
        return chosen

    def inside(self, items: Sequence[T]) -> list[T]:
        """Return the chosen items, maybe none."""
        within = [*enumerate(items)][self.window][:: self.stride]
        return [item for frame, item in within if self.takes(frame)][: self.most]

    def shortage(self, count: int) -> tuple[str, ...]:
        """Return a note if a sequence of `count` frames ends before the window."""
        if self.window.stop is None or count >= self.window.stop:
            return ()
        return (f"it has {count} frames; the protocol takes {self.window.start or 0} to {self.window.stop - 1}",)


EVERY_FRAME = FrameChoice()


def unpictured(
    frames: FrameChoice, pictures: Iterable[str], truth: Iterable[str], expected: Path | str
) -> tuple[LeftOut, ...]:
    """Return the frames of the choice that have a truth of some kind, by these names, and no picture.

    Pictures are `expected` there. A choice is made of the pictures that are there; the frames without count as left out
    where it would take them among all frames.
    """
    if frames.pinned is not None:  # all of them are there
        return ()
    named = [*pictures]
    lacking = {*truth} - {*named}
    wanted = frames.inside(in_order({*named} | lacking, Path))
    lost = [name for name in wanted if name in lacking]
    return left_out("pictures", lost, len(frames.inside(named)) + len(lost), "have no picture", expected)


@dataclass(frozen=True, eq=False)
class LabelledSequence:
    """Frames in order, and the ground truth that the data set has: metres, seconds, OpenCV's axes.

    Depth and masks are read at each use, by the frame's index. Intrinsics put the outer corner of the first pixel at
    (0, 0) and its centre at (0.5, 0.5); readers shift the intrinsics of data sets that count from the centre.
    """

    name: str
    pictures: tuple[Path, ...]
    depth: DepthReader | None = None  # along z, 0 where it is unknown; at the pictures' size
    mask: MaskReader | None = None  # True where the world moves; at the pictures' size; None for a frame without
    world_from_camera: Float64[np.ndarray, "S 4 4"] | None = None  # NaN for a frame without
    intrinsics: Float64[np.ndarray, "S 3 3"] | None = None
    timestamps: Float64[np.ndarray, " S"] | None = None
    notes: tuple[str, ...] = ()  # a sentence for each missing or skipped part
    left_out: tuple[LeftOut, ...] = ()  # frames that lack something
    frame_names: tuple[str, ...] = ()  # the pictures' names without endings by default
    archive: object | None = None  # keeps the temporary files that `pictures` are, if any
    tracks: TrueTracks | None = None

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

    @property
    def posed(self) -> Bool[np.ndarray, " S"]:
        """Frames with a camera pose."""
        poses = self.world_from_camera
        return np.zeros(len(self), bool) if poses is None else np.asarray(np.isfinite(poses).all(axis=(1, 2)))

    @property
    def resized(self) -> tuple[str, ...]:
        """Notes on the maps that were read so far, of other sizes than their pictures."""
        readers = {"depth": self.depth, "mask": self.mask}
        return tuple(note for what, maps in readers.items() if isinstance(maps, Maps) for note in maps.note(what))

    def of_frames(self, chosen: Sequence[int]) -> LabelledSequence:
        """Return the sequence of some frames, in this order."""

        def taken(values: Any) -> Any:
            if callable(values):
                return lambda frame: values(chosen[frame])
            if isinstance(values, tuple):
                return tuple(values[frame] for frame in chosen)
            return None if values is None else values[list(chosen)]

        names = ("pictures", "depth", "mask", "world_from_camera", "intrinsics", "timestamps", "frame_names")
        tracks = None if self.tracks is None else self.tracks.of_frames(chosen)
        return replace(self, tracks=tracks, **{name: taken(getattr(self, name)) for name in names})


Opener = Callable[[FrameChoice], LabelledSequence]
Reader = Callable[..., Mapping[str, Opener]]  # of a root, and of a ground truth where a data set has several


@dataclass(frozen=True)
class Maps:
    """Reads a file for each frame, at the size of its picture: each pixel takes the value of the file's around it.

    Attributes:
        strict: Refuse another size.
        is_depth: 0 where it is unknown: not finite, not above 0, or in a frame without a file.
        resized: Sizes of the maps that were read at another size than their pictures, and of these, by frame.
    """

    pictures: Sequence[Path]
    paths: Sequence[Path | None]
    read: Callable[[Path], Shaped[np.ndarray, "h w"]]
    strict: bool = False
    is_depth: bool = False
    resized: dict[int, tuple[tuple[int, ...], tuple[int, int]]] = field(default_factory=dict)

    def __call__(self, frame: int) -> Shaped[np.ndarray, "h w"] | None:
        """Return a frame's map, None for another one than depth without a file.

        Raises OtherShapeError, and InputError for another file.
        """
        values = self._fitted(frame)
        if not self.is_depth:
            return values
        if values is None:
            width, height = picture_size(self.pictures[frame])
            return np.zeros((height, width), np.float32)
        return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)

    def _fitted(self, frame: int) -> Shaped[np.ndarray, "h w"] | None:
        path = self.paths[frame]
        if path is None:
            return None
        values, (width, height) = self.read(path), picture_size(self.pictures[frame])
        if values.shape == (height, width):
            return values
        if self.strict or not alike(values.shape, (height, width)):
            turned = TURNED if values.shape == (width, height) else ""
            raise OtherShapeError(
                f"{path} has shape {values.shape}; expected {(height, width)}, the size of "
                f"{self.pictures[frame].name}{turned}"
            )
        self.resized[frame] = values.shape, (height, width)
        return at_size(values, (height, width))

    def note(self, what: str) -> tuple[str, ...]:
        """Return a note where some of the maps that were read have another size than their pictures."""
        if not self.resized:
            return ()
        (rows, columns), (height, width) = next(iter(self.resized.values()))
        count = f"in {len(self.resized)} of {len(self.paths)} frames"
        sizes = f"{columns} x {rows} pixels and pictures {width} x {height} {count}"
        return (f"its {what} has {sizes}; each pixel of a picture takes the value of the one around its centre",)


def alike(shape: tuple[int, ...], picture: tuple[int, int]) -> bool:
    """Return whether maps of a (height, width) have the shape of a picture, but for a pixel or a fiftieth."""
    rows, columns = shape
    height, width = picture
    across, down = columns * height, rows * width
    return abs(across - down) <= max(max(picture), _SAME_SHAPE * down)


def at_size(values: Shaped[np.ndarray, "h w"], size: tuple[int, int]) -> Shaped[np.ndarray, "H W"]:
    """Return a map at another (height, width): each pixel takes the value of the pixel around its centre."""
    rows, columns = (
        ((np.arange(side) + 0.5) * count / side).astype(int) for side, count in zip(size, values.shape, strict=True)
    )
    return values[rows[:, None], columns]


class Labels(NamedTuple):
    """A reader of maps, None where no frame has one, what is left out, and notes."""

    read: Any
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def map_reader(
    what: Literal["depth", "masks"],
    pictures: Sequence[Path],
    paths: Sequence[Path | None],
    read: Callable[[Path], Shaped[np.ndarray, "h w"]],
    expected: Path,
) -> Labels:
    """Return the `Maps` of the frames, the frames without any, which is `expected` there, and notes."""
    missing = [picture.stem for picture, path in zip(pictures, paths, strict=True) if path is None]
    if len(missing) == len(pictures):
        return Labels(None, (), (f"it has no {what}; expected {expected}",))
    maps, why = Maps(pictures, paths, read, is_depth=what == "depth"), f"have no {what.removesuffix('s')}"
    return Labels(maps, left_out(what, missing, len(paths), why, expected), ())


def refuse_left_out(sequence: LabelledSequence) -> LabelledSequence:
    """Return a sequence that refuses maps of another size; raises InputError where a frame lacks something."""
    for each in sequence.left_out:
        if not each.usual:
            raise InputError(f"{each.sentence}; add them, or score the other frames, without --strict")
    depth, mask = (replace(x, strict=True) if isinstance(x, Maps) else x for x in (sequence.depth, sequence.mask))
    return replace(sequence, depth=depth, mask=mask)


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
