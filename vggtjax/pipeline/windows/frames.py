"""The frames of each window, read when the window is run: at most two windows of frames are in memory.

Does not import jax.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from vggtjax.clips.clip import Clip, read_clip, warn_of_left_out
from vggtjax.clips.media.sampling import Frame, Sampling, Source
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.shots import ShotWatch
from vggtjax.errors import ClipError
from vggtjax.results.result import Result


@dataclass(frozen=True)
class _Next:
    """The next frames of a source that is being read, as a source of their own; they can be read once."""

    name: str
    reading: Iterator[Frame]
    count: int

    def total(self, sampling: Sampling) -> int:
        del sampling
        return self.count

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        del sampling
        return islice(self.reading, self.count)


def count_frames(source: Source, sampling: Sampling, most: int | None = None) -> int:
    """Return how many frames are taken; a video is decoded for it, a frame at a time, up to `most` frames."""
    total = source.total(sampling)
    return sum(1 for _ in islice(source.frames(sampling), most)) if total is None else total


def window_clips(source: Source, sampling: Sampling, fitter: Fitter, windows: Sequence[range]) -> Iterator[Clip]:
    """Yield the clip of each window; the source is read once, in order, and what is to be warned about is logged once.

    Raises ClipError where the source has fewer frames than planned, or its frames have several sizes.
    """
    warn_of_left_out(source)
    watch = ShotWatch(sampling)
    reading = watch.over(source.frames(sampling))
    held: Clip | None = None
    read = 0
    for window in windows:
        count = window.stop - read
        try:
            fresh = read_clip(_Next(source.name, reading, count), Sampling(), fitter, warn=held is None, is_part=True)
        except ValueError as error:
            if isinstance(error, ClipError):
                raise
            raise _changed(read) from error
        if len(fresh) < count:
            raise _changed(read + len(fresh))
        (watch.warn if window.stop == windows[-1].stop else watch.warn_early)()
        clip = fresh if held is None else _joined(held, fresh)
        read = window.stop
        held = _part(clip, range(len(clip) - len(window), len(clip)))
        yield dataclasses.replace(held, source=source, sampling=sampling)


def clip_of(frames: Sequence[tuple[Result, int]], like: Clip) -> Clip:
    """Return frames of the results of windows as a clip of their own."""

    def stacked(name: str) -> np.ndarray:
        return np.stack([getattr(result, name)[number] for result, number in frames])

    timed = frames[0][0].timestamps is not None
    return dataclasses.replace(
        like,
        images=stacked("images") / np.float32(255),
        frame_names=[result.frame_names[number] for result, number in frames],
        timestamps=stacked("timestamps") if timed else None,
        **{name: stacked(name) for name in _PLACES},
    )


class SeenFrames:
    """Where the frames of the windows lie in the source: what is known of a clip that is never in memory as a whole."""

    def __init__(self) -> None:
        self._clip: Clip | None = None
        self._parts: dict[str, list[np.ndarray]] = {name: [] for name in _PLACES}

    def add(self, clip: Clip, window: range) -> None:
        """Note the frames of a window; windows come in order."""
        known = sum(map(len, self._parts["valid_box"]))
        for name, parts in self._parts.items():
            parts.append(getattr(clip, name)[known - window.start :])
        self._clip = clip

    def clip(self) -> Clip:
        """Return a clip of the frames that were seen, whose pictures are black."""
        assert self._clip is not None
        arrays = {name: np.concatenate(parts) for name, parts in self._parts.items()}
        frames = len(arrays["valid_box"])
        images = np.broadcast_to(np.float32(0), (frames, *self._clip.images.shape[1:]))
        names = [str(frame) for frame in range(frames)]
        return dataclasses.replace(self._clip, images=images, frame_names=names, timestamps=None, **arrays)


_PLACES = ("source_size", "source_scale", "source_offset", "valid_box")
_ARRAYS = ("images", *_PLACES)


def _joined(first: Clip, second: Clip) -> Clip:
    sizes = [clip.images.shape[1:3] for clip in (first, second)]
    if sizes[0] != sizes[1]:
        (a, b), (c, d) = sizes
        raise ClipError(
            f"frame {second.frame_names[0]} is fitted to {d} x {c} pixels and those before it to {b} x {a}; windows "
            "need frames of one size, as mode 'pad' (--preprocess pad) makes them"
        )
    arrays = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in _ARRAYS}
    times = None if first.timestamps is None else np.concatenate([first.timestamps, second.timestamps])  # pyright: ignore
    names = [*first.frame_names, *second.frame_names]
    return dataclasses.replace(second, **arrays, timestamps=times, frame_names=names)


def _part(clip: Clip, frames: range) -> Clip:
    chosen = slice(frames.start, frames.stop)
    arrays = {name: getattr(clip, name)[chosen] for name in _ARRAYS}
    times = None if clip.timestamps is None else clip.timestamps[chosen]
    return dataclasses.replace(clip, **arrays, timestamps=times, frame_names=clip.frame_names[chosen])


def _changed(frames: int) -> ClipError:
    return ClipError(f"the source now ends after {frames} frames, not as when it was counted; start again")
