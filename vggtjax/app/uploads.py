"""What strangers send: a checked video, or checked pictures, in the folder of a job. Does not import jax."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from vggtjax.app.limits import Limits
from vggtjax.clips.images import is_image_name
from vggtjax.clips.order import natural_key
from vggtjax.clips.sampling import Sampling, Source
from vggtjax.clips.sources import open_source
from vggtjax.clips.video import VideoFile, is_video_name
from vggtjax.errors import ClipError, one_line

_MOST_PICTURES = 1000
_UNKNOWN_LENGTH_FPS = 4.0  # frames per second of a video that does not say how long it is


def keep(files: Sequence[Path], uploads: Path, folder: Path, limits: Limits) -> Path | tuple[Path, ...]:
    """Link one video or several pictures of `uploads` into `folder`; return what `open_source` opens.

    Names are made safe, and pictures sorted as a folder's are. Raises ClipError for files that cannot be a clip by
    their number, name or size, or that are gone.
    """
    if not files:
        raise ClipError("no file was sent; choose a video, or several pictures")
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
    folder.mkdir(parents=True)
    kept = []
    for number, path in enumerate(sorted(paths, key=lambda path: (natural_key(Path(path.name)), str(path)))):
        order = "" if videos else f"{number:06d}-"
        place = folder / f"{order}{safe_stem(path.name)}{path.suffix.lower()}"
        _link(path, place)
        kept.append(place)
    return kept[0] if videos else tuple(kept)


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


def _link(path: Path, place: Path) -> None:
    try:
        os.link(path, place)
    except OSError:  # another file system, or one without links
        shutil.copyfile(path, place)
