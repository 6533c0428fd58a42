"""The pictures of a capture as the source of a clip. Does not import jax."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from vggtjax.captures.capture import Capture
from vggtjax.captures.files import folder_name
from vggtjax.captures.lens import Undistortion
from vggtjax.media.images import ImageFiles, read_image
from vggtjax.media.sampling import Frame, Sampling


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

    @property
    def first_time(self) -> float | None:
        """The time of the capture's first frame by its own clock, in seconds; times of frames count from it."""
        return None if self.capture.timestamps is None else float(self.capture.timestamps[0])

    @property
    def lenses_undone(self) -> str:
        """The models of the lenses whose distortion is undone, in words; empty where there are none."""
        return " and ".join(sorted({made.lens.model for made in self.capture.undone or () if made is not None}))

    def undistortion(self, name: str) -> Undistortion | None:
        """Return how the frame of this name is undistorted, None where it is as its file has it."""
        return None if self.capture.undone is None else self.capture.undone[self.frame_names.index(name)]

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes. Raises ClipError for a file that cannot be read."""
        times = self.capture.timestamps
        for index in self.taken(sampling):
            time = None if times is None else float(times[index] - times[0])
            with self.capture.naming_files():
                image = read_image(self.paths[index], self._said)
            made = None if self.capture.undone is None else self.capture.undone[index]
            if made is not None:
                image = made.picture(image)
            yield Frame(self.frame_names[index], image, time)

    def taken(self, sampling: Sampling) -> list[int]:
        """Return the indices of the pictures that `sampling` takes, with `fps` by their times."""
        times = self.capture.timestamps
        if sampling.fps is None or times is None:
            return list(sampling.indices(len(self.paths)))
        return [index for index, _, _ in sampling.select((float(time - times[0]), None) for time in times)]
