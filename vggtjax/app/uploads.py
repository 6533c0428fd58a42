"""What users send: a checked video, or checked pictures. Does not import jax."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path

from vggtjax.app.limits import Limits
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError, one_line
from vggtjax.media.images import is_image_name
from vggtjax.media.order import in_order
from vggtjax.media.sampling import Sampling, Source
from vggtjax.media.video import VideoFile, is_video_name

_MOST_PICTURES = 1000
_IN_USE = 3600  # seconds after an upload in which it stays
_UNKNOWN_LENGTH_FPS = 4.0  # frames per second of a video that does not say how long it is


def room_for(uploads: Path, needed: int, most: int) -> bool:
    """Return whether `needed` more bytes keep the uploads below `most`; if not, the oldest ones go first.

    Uploads of the last hour stay, as a job may read them. Parts of uploads that were cut are files like the others.
    """
    files = sorted((path.stat().st_mtime, path) for path in uploads.rglob("*") if path.is_file())
    total = needed + sum(path.stat().st_size for _, path in files)
    for written, path in files:
        if total <= most or time.time() - written < _IN_USE:
            break
        total -= path.stat().st_size
        path.unlink()
    return total <= most


def clip_of(files: Sequence[Path], uploads: Path, limits: Limits) -> Path | tuple[Path, ...]:
    """Return the one video, or the pictures in the order of a folder's, among the files of `uploads`.

    Raises ClipError for files that cannot be a clip by their number, name or size, or that are no uploads.
    """
    paths = [path.resolve() for path in files]
    names = ", ".join(one_line(path.name, 60) for path in paths[:3])
    if not all(path.is_relative_to(uploads.resolve()) and path.is_file() for path in paths):
        raise ClipError(f"{names}: the upload is not here any more; send it again")
    videos = [path for path in paths if is_video_name(path)]
    if not videos and not all(is_image_name(path) for path in paths):
        raise ClipError(f"{names}: by its name this is no video and no picture; send one such as .mp4, .mov or .jpg")
    if videos and len(paths) > 1:
        raise ClipError(f"{len(paths)} files with a video among them; send one video, or pictures only")
    if len(paths) > _MOST_PICTURES:
        raise ClipError(f"{len(paths)} pictures were sent; send at most {_MOST_PICTURES}")
    total = sum(path.stat().st_size for path in paths)
    if total > limits.upload_bytes:
        raise ClipError(f"the upload has {total / 1e6:.1f} MB; send at most {limits.max_upload_mb} MB")
    return videos[0] if videos else tuple(in_order(paths, lambda path: Path(path.name)))


def check_clip(
    source: Path | tuple[Path, ...], frames: int, fps: float | None, limits: Limits
) -> tuple[Source, Sampling]:
    """Return the opened source, and which of its frames are taken.

    Without `fps`, `frames` are spread evenly over the whole source; pictures have no `fps`. Raises ClipError for a
    source that cannot be read or is longer than the limit.
    """
    opened = open_source(source)
    next(opened.frames(Sampling()))  # finds a broken file before the model is loaded
    if not isinstance(opened, VideoFile):
        count = opened.total(Sampling()) or 1
        return opened, Sampling(stride=-(-count // frames), max_frames=frames)
    seconds = opened.seconds()
    if seconds is not None and seconds > limits.max_seconds:
        raise ClipError(f"the video is {seconds:.0f} s long; send at most {limits.max_seconds} s")
    if fps is None:
        fps = frames / seconds if seconds and seconds > 0 else _UNKNOWN_LENGTH_FPS
    return opened, Sampling(fps=fps, max_frames=frames)


def safe_stem(name: str) -> str:
    """Return a file's name without its suffix, of letters, digits, dots and dashes only, at most 60 of them."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", Path(name).stem)[:60].strip(".-") or "clip"
