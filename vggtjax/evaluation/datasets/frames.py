"""The frames of a sequence that a protocol takes. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from vggtjax.clips.sampling import Sampling
from vggtjax.errors import InputError

T = TypeVar("T")


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
