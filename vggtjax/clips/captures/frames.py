"""The pictures of a capture as the source of a clip. Does not import jax."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property

from vggtjax.clips.captures.capture import Capture
from vggtjax.clips.captures.files import folder_name
from vggtjax.clips.captures.lens import Undistortion
from vggtjax.clips.media.images import ImageFiles, read_image, stated_times
from vggtjax.clips.media.sampling import Frame, Sampling
from vggtjax.clips.media.times import FrameTimes


@dataclass(frozen=True)
class CaptureFrames(ImageFiles):
    """The frames of a capture, in its order and by its names, with its times where it has some."""

    capture: Capture

    @property
    def name(self) -> str:
        """The name of the capture's folder, or of its file without the suffix."""
        path = self.capture.path
        return folder_name(path) if path.is_dir() else path.stem

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Those of the capture."""
        return self.capture.frame_names

    @cached_property
    def times(self) -> FrameTimes | None:
        """The times by the capture's own clock, or else those that the files state."""
        if self.capture.timestamps is None:
            return None if self.capture.archive is not None else stated_times(self.paths)
        seconds = tuple(Decimal(repr(float(time))) for time in self.capture.timestamps)
        return FrameTimes(seconds, f"the capture ({self.capture.kind})")

    @property
    def lenses_undone(self) -> str:
        """The models of the lenses whose distortion is undone, in words; empty where there are none."""
        return " and ".join(sorted({made.lens.model for made in self.capture.undone or () if made is not None}))

    def undistortion(self, name: str) -> Undistortion | None:
        """Return how the frame of this name is undistorted, None where it is as its file has it."""
        return None if self.capture.undone is None else self.capture.undone[self.frame_names.index(name)]

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes. Raises ClipError for a file that cannot be read."""
        times = None if self.times is None else self.times.from_first
        for index in self.taken(sampling):
            time = None if times is None else float(times[index])
            with self.capture.naming_files():
                image = read_image(self.paths[index], self._said)
            made = None if self.capture.undone is None else self.capture.undone[index]
            if made is not None:
                image = made.picture(image)
            yield Frame(self.frame_names[index], image, time, index=index)
