"""Windows for a clip that does not fit in memory as a whole, chosen before it is loaded."""

from __future__ import annotations

from typing import NamedTuple

from vggtjax.checkpoint import Model
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sampling import Sampling, Source
from vggtjax.pipeline import memory
from vggtjax.windows.frames import count_frames
from vggtjax.windows.plan import Windows

_LENGTHS = (64, 48, 32, 24, 16, 12, 8)  # frames of a window, the longest that fits
_GIGA = 1e9


class Choice(NamedTuple):
    """Whether a clip is to be cut, and why."""

    windows: Windows  # without a window where the clip fits
    frames: int  # of the clip
    needed: float  # bytes, of all frames together
    free: float  # bytes

    @property
    def sizes(self) -> str:
        """What the clip needs and what there is, as the beginning of a sentence."""
        unit = "frame needs" if self.frames == 1 else "frames need"
        return f"{self.frames} {unit} about {self.needed / _GIGA:.1f} GB, {self.free / _GIGA:.1f} GB are free"

    @property
    def sentence(self) -> str:
        """What is done about a clip that does not fit."""
        cut = f"running windows of {self.windows.window} frames, overlap {self.windows.overlap}"
        return f"{self.sizes}: {cut}; --window 0 runs all together"


def choose_windows(model: Model, source: Source, sampling: Sampling, fitter: Fitter) -> Choice | None:
    """Return windows for a clip that does not fit in memory; None for one that does, or where memory is not known.

    The frames of a video are decoded to be counted, but no more of them than fit.
    """
    free = memory.available_bytes(model)
    if free is None:
        return None
    frame = next(source.frames(sampling))
    width, height = fitter.fit(*frame.image.size, frame.name).frame_size
    most = memory.most_frames(model, height, width, free)
    if count_frames(source, sampling, most + 1) <= most:
        return None
    frames = count_frames(source, sampling)
    fitting = [length for length in _LENGTHS if length <= most]
    windows = Windows((fitting or _LENGTHS[-1:])[0])
    return Choice(windows, frames, memory.predicted_bytes(model, frames, height, width), free)
