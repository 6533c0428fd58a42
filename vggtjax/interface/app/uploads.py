"""What users send: a checked video, or checked pictures. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vggtjax.clips.media.images import is_image_name
from vggtjax.clips.media.order import in_order
from vggtjax.clips.media.sampling import Sampling, Source
from vggtjax.clips.media.video import VideoFile, is_video_name
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError, one_line
from vggtjax.interface.app.limits import Limits

_MOST_PICTURES = 1000
_UNKNOWN_LENGTH_FPS = 4.0  # frames per second of a video that does not say how long it is


def checked_clip(files: Sequence[Path], frames: int, fps: float, limits: Limits) -> tuple[Source, Sampling]:
    """Return the one video, or the pictures in the order of a folder's, and which of its frames are taken.

    With `fps` 0, `frames` are spread evenly over the whole source; pictures have no `fps`. Raises ClipError for files
    that are no clip by number, name, size or content, and for a video that is longer than the limit.
    """
    files = in_order(files, lambda path: Path(path.name))
    names = ", ".join(one_line(path.name, 60) for path in files[:3])
    if not all(path.is_file() for path in files):
        raise ClipError(f"{names}: the upload is not here any more; send it again")
    is_video = any(map(is_video_name, files))
    if not is_video and not all(map(is_image_name, files)):
        raise ClipError(f"{names}: by its name this is no video and no picture; send one such as .mp4, .mov or .jpg")
    if len(files) > (1 if is_video else _MOST_PICTURES):
        raise ClipError(f"{len(files)} files were sent; send one video, or at most {_MOST_PICTURES} pictures")
    if (megabytes := sum(path.stat().st_size for path in files) / 1e6) > limits.max_upload_mb:
        raise ClipError(f"the upload has {megabytes:.1f} MB; send at most {limits.max_upload_mb} MB")
    source = open_source(files[0] if is_video else files)
    next(source.frames(Sampling()))  # finds a broken file before the model is loaded
    if not isinstance(source, VideoFile):
        return source, Sampling(stride=-(-len(files) // frames), max_frames=frames)
    seconds = source.seconds() or 0.0
    if seconds > limits.max_seconds:
        raise ClipError(f"the video is {seconds:.0f} s long; send at most {limits.max_seconds} s")
    spread = frames / seconds if seconds > 0 else _UNKNOWN_LENGTH_FPS
    return source, Sampling(fps=fps or spread, max_frames=frames)
