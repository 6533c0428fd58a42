"""Which frames of a sequence a protocol takes. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from vggtjax.clips.sampling import Sampling
from vggtjax.errors import InputError

T = TypeVar("T")


class FrameChoice(NamedTuple):
    """A window of frames, then every so many of them, then at most so many."""

    window: slice = slice(None)
    stride: int = 1
    most: int | None = None

    def sampled(self, sampling: Sampling) -> FrameChoice:
        """Return the frames that `sampling` takes of the window; its stride, if given, replaces this one."""
        window = slice((self.window.start or 0) + sampling.start, self.window.stop)
        stride = self.stride if sampling.stride is None else sampling.stride
        mosts = [most for most in (self.most, sampling.max_frames) if most is not None]
        return FrameChoice(window if sampling.start else self.window, stride, min(mosts, default=None))

    def of(self, items: Sequence[T], name: str) -> list[T]:
        """Return those of `items`, one for each frame of the sequence `name`; raises InputError where none is left."""
        if not items:
            raise InputError(f"sequence {name} has no frames; expected one at least")
        chosen = list(items[self.window][:: self.stride][: self.most])
        if not chosen:
            raise InputError(f"sequence {name} has {len(items)} frames, and none of them from {self.window.start} on")
        return chosen

    def shortage(self, count: int) -> tuple[str, ...]:
        """Return a note where a sequence of `count` frames ends before the window does."""
        if self.window.stop is None or count >= self.window.stop:
            return ()
        return (f"it has {count} frames; the protocol takes {self.window.start or 0} to {self.window.stop - 1}",)


EVERY_FRAME = FrameChoice()
