"""Whether a clip fits in memory, told before it is loaded: windows for one that does not, and what else would fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vggtjax.clips.media.sampling import Sampling, Source
from vggtjax.clips.preprocessing import Fitter
from vggtjax.config import VGGTConfig
from vggtjax.errors import DeviceMemoryError
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline import memory
from vggtjax.pipeline.windows.frames import count_frames
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.storage.memory import in_gigabytes

_LENGTHS = (64, 48, 32, 24, 16, 12, 8)  # frames of a window, the longest that fits


class Planned(NamedTuple):
    """The size of a model that is not loaded."""

    config: VGGTConfig
    parameter_bytes: int


class WindowsChoice(NamedTuple):
    """A clip that does not fit as a whole, and what is done about it."""

    windows: Windows  # the longest that fit; the shortest where none does
    frames: int  # of the clip
    needed: float  # bytes, of all frames together
    free: float  # bytes
    limit: str  # what limits them
    smaller: tuple[str, ...]  # what would fit without windows
    is_hard: bool = False  # whether the limit is one of the process or its container, and not what is free just now

    @property
    def sizes(self) -> str:
        """What the clip needs and what there is, as the beginning of a sentence."""
        unit = "frame needs" if self.frames == 1 else "frames need"
        free = f"{in_gigabytes(self.free)} are free {self.limit}"
        return f"{self.frames} {unit} about {in_gigabytes(self.needed)}, {free}"

    @property
    def sentence(self) -> str:
        """What is done about a clip that does not fit."""
        return f"{self.sizes}: running windows of {self.windows.window} frames, overlap {self.windows.overlap}"

    @property
    def is_cut(self) -> bool:
        """Whether windows fit, and the clip is longer than one."""
        return self.windows.cuts(self.frames)

    @property
    def cannot_fit(self) -> bool:
        """Whether the clip is predicted not to fit: without a hard limit, even if too much is predicted, by its error.

        What is free of a computer can grow while the clip is read; a process that meets a hard limit is ended.
        """
        return self.needed * (1 if self.is_hard else 1 - memory.ERROR) > self.free

    def refusal(self, *, cuts: bool = True) -> DeviceMemoryError:
        """Return the error that says what would fit; `cuts` tells whether the clip can be cut into windows."""
        ways = [*([f"--window {self.windows.window}"] if cuts and self.is_cut else []), *self.smaller]
        advice = f"what fits: {', or '.join(ways)}" if ways else "no smaller clip fits"
        return DeviceMemoryError(f"{self.sizes}; {advice} (--no-memory-check runs it all the same)")


def choose_windows(
    model: Model,
    source: Source,
    sampling: Sampling,
    fitter: Fitter,
    *,
    window: int | None = None,
    method: str = "4dvggt-d",
    clips: int = 1,
    devices: int = 1,
) -> WindowsChoice | None:
    """Return windows for a clip that does not fit in memory; None for one that does, or where memory is not known.

    The frames of a video are decoded to be counted, but no more of them than fit.

    Args:
        model, source, sampling, fitter: what is run.
        window: frames that are run together, where windows are given; by default all of the clip.
        method: by its name.
        clips: held in memory at the same time.
        devices: that share the frames.
    """
    how: memory.Load = {"method": method, "clips": clips, "devices": devices}
    room = memory.available(model.params)
    if room is None:
        return None
    frame = next(source.frames(sampling))
    width, height = fitter.fit(*frame.image.size, frame.name).frame_size
    most = memory.most_frames(model, height, width, room.size, **how)
    frames = min(count_frames(source, sampling, most + 1), window or most + 1)
    if frames <= most:
        return None
    if window is None:
        frames = count_frames(source, sampling)
    windows = Windows(next((length for length in _LENGTHS if length <= most), _LENGTHS[-1]))
    if windows.window is not None and windows.window > most:  # not even the shortest fits
        windows = Windows()
    need = partial(memory.predicted_bytes, **how)
    needed = need(model, frames, height, width)
    smaller = _smaller(model, (frames, height, width), fitter, room.size, most, need)
    return WindowsChoice(windows, frames, needed, room.size, room.limit, smaller, room.is_hard)


def smaller_window(frames: int) -> Windows | None:
    """Return the longest windows of at most half of the frames that did not fit; None for too few frames."""
    length = next((length for length in _LENGTHS if length <= frames // 2), None)
    return None if length is None else Windows(length)


def smaller_size(fitter: Fitter) -> Fitter | None:
    """Return the fitter of about half of the pixels; None where that is less than two patches."""
    size = int(fitter.size * 0.71) // fitter.patch * fitter.patch
    return None if size < 2 * fitter.patch else dataclasses.replace(fitter, size=size)


def _smaller(
    model: Model, shape: tuple[int, int, int], fitter: Fitter, free: float, most: int, need: Callable[..., float]
) -> tuple[str, ...]:
    """Return what would fit, each as the option that does it."""
    frames, height, width = shape

    def fits(network: memory.Sized, height: int, width: int) -> bool:
        return need(network, frames, height, width) <= free

    ways = [] if most < 1 else [f"--max-frames {most}"]
    for size in range(fitter.size - fitter.patch, fitter.patch, -fitter.patch):
        scale = size / fitter.size
        if fits(model, max(1, round(height * scale)), max(1, round(width * scale))):
            ways.append(f"--size {size}")
            break
    if model.dtype == "float32" and fits(Planned(model.config, model.parameter_bytes // 2), height, width):
        ways.append("weights of half the size (vggtjax convert --dtype bfloat16)")
    return tuple(ways)
