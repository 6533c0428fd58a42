"""Sources of a clip: files, folders, patterns or arrays. Does not import jax."""

from __future__ import annotations

import glob
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from PIL import Image, ImageOps

from vggtjax.clips.captures.files import folder_name
from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.captures.lens import check_no_fisheye
from vggtjax.clips.captures.table import RECORD3D_SUFFIX, capture_kind, find_capture
from vggtjax.clips.manifest import MOST_BYTES, is_manifest, read_manifest, source_name
from vggtjax.clips.media.animation import Animation, is_animation
from vggtjax.clips.media.arrays import ArrayFrames
from vggtjax.clips.media.images import ImageFiles, is_image_name, to_rgb
from vggtjax.clips.media.order import in_order
from vggtjax.clips.media.sampling import Source
from vggtjax.clips.media.video import VideoFile, is_video_name
from vggtjax.clips.mixture import check_colours, check_frames, odd_ones
from vggtjax.errors import ClipError, InputError, reading
from vggtjax.storage.remote import check_url, download, is_url, list_url, local_path, shown, url_name

_NUMBERED = re.compile(r"%0?(\d?)d")  # a number of at least so many digits, in C's words

Name: TypeAlias = str | os.PathLike[str]
ClipSource: TypeAlias = Name | Sequence[Name] | Sequence[Image.Image] | Sequence[np.ndarray] | np.ndarray | Source

_OPENED = (ImageFiles, VideoFile, Animation, ArrayFrames)


def open_source(source: ClipSource, *, undistort: bool | None = True) -> Source:
    """Return the source of frames that `source` names, without reading the frames; `load_clip` lists what it can be.

    With `undistort` the frames of a capture that has coefficients of its lens are those that a pinhole would see; with
    None they are as they are, whatever the lens: to look at files.
    Raises ClipError for a missing source, one without frames, or lenses that no pinhole stands for, and
    MissingExtraError where frames are to be undistorted and pycolmap is not installed.
    """
    if isinstance(source, _OPENED):
        return source
    if isinstance(source, (str, os.PathLike)):
        return _from_path(os.fspath(source), undistort)
    if hasattr(source, "__array__"):
        return ArrayFrames.from_arrays(source)
    if isinstance(source, Sequence) and not isinstance(source, bytes):
        items: list[Any] = list(source)
        if not items:
            raise ClipError("the list of frames is empty; expected image paths or arrays")
        if all(isinstance(item, (str, os.PathLike)) for item in items):
            return _from_list([Path(item) for item in items])
        if all(isinstance(item, Image.Image) for item in items):
            said: set[str] = set()
            items = [np.asarray(to_rgb(ImageOps.exif_transpose(item), f"{i}", said)) for i, item in enumerate(items)]
        if all(hasattr(item, "__array__") for item in items):
            return ArrayFrames.from_arrays(items)
        kinds = ", ".join(sorted({type(item).__name__ for item in items}))
        raise ClipError(f"the list of frames holds {kinds}; expected image paths only, or arrays only")
    raise ClipError(
        f"the source is of type {type(source).__name__}; expected a folder, a pattern, an image or video file, "
        f"a list of image paths, or arrays"
    )


def clips_by_name(paths: Sequence[str]) -> dict[str, str]:
    """Return the sources of clips, paths or URLs, by name.

    `paths` are folders of images, videos, folders that hold such clips, or lists of clips (`read_manifest`), each a
    path or a URL. A clip is named as its list says, after its folder, or after its video without the suffix. Raises
    ClipError for a path without clips, or two clips of one name.
    """
    found: dict[str, str] = {}
    for text in paths:
        listed = _at_url(text) if is_url(text) else _at_path(local_path(text))
        if not listed:
            raise ClipError(f"{shown(text)} is not a clip and holds no clips; expected folders of images, or videos")
        for name, clip in listed:
            if name in found:
                raise ClipError(f"two clips are named {name}: {shown(found[name])} and {shown(clip)}; rename one")
            found[name] = clip
    if not found:
        raise ClipError("no clips; name folders of images, videos, or a folder of such")
    return found


def _at_path(text: str) -> list[tuple[str, str]]:
    """Return names and sources of the clips at a path."""
    path = Path(text)
    with reading(path, ClipError):
        if not path.exists():
            raise _missing(text)
        if is_manifest(text) and path.is_file():
            return list(read_manifest(path).items())
        entries = in_order(path.iterdir()) if path.is_dir() else [path]
        whole = not path.is_dir() or any(is_image_name(entry) for entry in entries) or bool(capture_kind(path))
        clips = [path] if whole else [entry for entry in entries if _is_clip(entry)]
        return [(folder_name(clip) if clip.is_dir() else clip.stem, str(clip)) for clip in clips]


def _at_url(url: str) -> list[tuple[str, str]]:
    """Return names and sources of the clips at a URL. A list of clips is downloaded, other files are not."""
    check_url(url, error=ClipError)
    name = Path(url_name(url, ClipError))
    if is_manifest(name.name):
        with tempfile.TemporaryDirectory() as folder:
            path = download(url, Path(folder), most_bytes=MOST_BYTES, error=ClipError)
            try:
                return list(read_manifest(path, url).items())
            except ClipError as error:
                raise ClipError(str(error).replace(str(path), shown(url))) from None
    entries = [] if _is_clip_file(name) or is_image_name(name) else list_url(url, ClipError)
    if not entries or any(is_image_name(Path(entry.name)) for entry in entries):
        return [(source_name(url), url)] if entries or name.suffix else []
    entries = in_order(entries, lambda entry: Path(entry.name))
    clips = [e.url for e in entries if not e.name.startswith(".") and (e.is_folder or _is_clip_file(Path(e.name)))]
    return [(source_name(clip), clip) for clip in clips]


def _is_clip_file(name: Path) -> bool:
    return is_video_name(name) or name.suffix.lower() == RECORD3D_SUFFIX


def _is_clip(entry: Path) -> bool:
    return not entry.name.startswith(".") and (entry.is_dir() or is_video_name(entry) or bool(capture_kind(entry)))


def _from_path(name: str, undistort: bool | None) -> Source:
    path = Path(name)
    with reading(name, ClipError):
        if not name or "\0" in name:
            raise ClipError(f"{name!r} is not a path; expected a folder, a pattern, or an image or video file")
        if (capture := _capture(path, undistort)) is not None:
            return capture
        if path.is_dir():
            entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
            return _images(entries, f"folder {path} holds", "name the folder or file with the frames")
        if path.is_file():
            return _from_file(path)
        if path.exists():
            raise ClipError(f"{path} is neither a file nor a folder; expected images or a video")
        if _NUMBERED.search(path.name) and not glob.has_magic(path.name):
            return _images(_numbered(path), f"pattern {name} matches", "expected images")
        if glob.has_magic(name) and "://" not in name:
            found = glob.glob(_pattern(path), recursive=True)  # noqa: PTH207 - absolute patterns too
            matches = [Path(match) for match in found]
            return _images(matches, f"pattern {name} matches", "expected images")
    raise _missing(name)


def _numbered(path: Path) -> list[Path]:
    """Return the files of a pattern such as img%04d.png, as FFmpeg writes it: a number in the name."""
    before, digits, after = _NUMBERED.split(path.name, maxsplit=1)
    number = rf"\d{{{digits or 1},}}"
    name = re.compile(re.escape(before) + number + re.escape(after))
    return [entry for entry in path.parent.iterdir() if name.fullmatch(entry.name)] if path.parent.is_dir() else []


def _pattern(path: Path) -> str:
    """Return a pattern with the signs in the names of folders that are there escaped: a[1] may be a folder's name."""
    there = next(parent for parent in path.parents if parent.is_dir() or parent == parent.parent)
    if there == Path():
        return str(path)
    return os.path.join(glob.escape(str(there)), path.relative_to(there))  # noqa: PTH118


def _capture(path: Path, undistort: bool | None) -> CaptureFrames | None:
    try:
        capture = find_capture(path)
        if capture is not None and undistort:
            capture = capture.undistorted()
        elif capture is not None and undistort is not None:
            check_no_fisheye(capture.lenses, path)
    except InputError as error:
        raise ClipError(f"{error}; name the folder of the pictures to leave its cameras out") from error
    return None if capture is None else CaptureFrames(tuple(path.absolute() for path in capture.pictures), capture)


def _missing(name: str) -> ClipError:
    if "://" in name:
        return ClipError(f"{name} is a URL; download the file first, or give it to vggtjax batch")
    return ClipError(f"'{name}' does not exist; expected a folder, a pattern, or an image or video file")


def _from_file(path: Path) -> Source:
    if is_image_name(path):
        return Animation(path.absolute()) if is_animation(path) else ImageFiles((path.absolute(),))
    if is_video_name(path):
        return VideoFile(path.absolute())
    raise ClipError(f"{path} has the name of neither an image nor a video; expected one such as .png, .jpg or .mp4")


def _from_list(paths: list[Path]) -> Source:
    for path in paths:
        if not os.path.isfile(path):  # noqa: PTH113 - False, not an error, for an over-long or forbidden path
            raise ClipError(f"image {path} does not exist or is not a file; check the list of frames")
        if is_video_name(path):
            raise ClipError(f"{path} is a video; give one video at a time, or several to vggtjax batch")
    check_colours(paths)
    return ImageFiles(tuple(path.absolute() for path in paths))


def _images(paths: list[Path], place: str, advice: str) -> Source:
    """Return the image files among `paths` in natural order, absolute; names that tie keep a fixed order.

    Raises ClipError where there are none, or several for each frame.
    """
    entries = in_order(path.absolute() for path in paths)
    images = [path for path in entries if is_image_name(path) and path.is_file()]
    if not images:
        raise ClipError(f"{place} no images{_inventory(paths)}; {advice}")
    check_frames(images, place)
    check_colours(images)
    return ImageFiles(tuple(images), notes=odd_ones(entries, images))


def _inventory(entries: list[Path]) -> str:
    """Return in words, after a comma, the number of folders, videos and other files, and up to three names of each."""
    names: dict[str, list[str]] = {"folder": [], "video": [], "other file": []}
    for entry in in_order(entries):
        names["folder" if entry.is_dir() else "video" if is_video_name(entry) else "other file"].append(entry.name)
    found = [
        f"{len(some)} {kind}{'s' if len(some) > 1 else ''} ({', '.join(some[:3])}{', ...' if len(some) > 3 else ''})"
        for kind, some in names.items()
        if some
    ]
    return f", but {' and '.join(found)}" if found else ""
