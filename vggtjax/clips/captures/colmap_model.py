"""Cameras and images of a COLMAP model, binary (cameras.bin, images.bin) or text. Does not import jax.

The layout is that of COLMAP's documentation (https://colmap.github.io/format.html) and of its `Reconstruction`, which
writes the binary form: little-endian, a count of 64 bits, then the records. COLMAP puts the outer corner of the first
pixel at (0, 0), as this library does.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import scipy
from jaxtyping import Float64

from vggtjax.clips.captures.cameras import PIXEL_CENTRE, intrinsics_matrix
from vggtjax.clips.captures.files import read_bytes, read_text
from vggtjax.clips.captures.lens import MODELS, Lens, lens_of
from vggtjax.errors import InputError, one_line, reading

Suffix = Literal[".bin", ".txt"]

# Camera models in the order of COLMAP's numbers, which the binary form has.
_NAMES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
_POINT_BYTES = 24  # of an observation in images.bin: x, y, the point's number
_IMAGE_WORDS = 10  # of the first line of an image in images.txt
_MOST_SIDE = 10**6  # pixels of a picture


_Camera: TypeAlias = tuple[Float64[np.ndarray, "3 3"], tuple[int, int], Lens | None]  # the first fields of ColmapView


class ColmapView(NamedTuple):
    """A registered image: its camera in pixels, the size of its picture, and its pose."""

    intrinsics: Float64[np.ndarray, "3 3"]
    size: tuple[int, int]  # width, height
    lens: Lens | None  # with a distortion, which the intrinsics lack
    camera_from_world: Float64[np.ndarray, "3 4"]


def read_views(folder: Path, suffix: Suffix = ".bin") -> dict[str, ColmapView]:
    """Return the registered images of a model by name.

    Raises InputError for files that end early, other camera models, and invalid cameras.
    """
    binary = suffix == ".bin"
    path = folder / f"images{suffix}"
    cameras = (_binary_cameras if binary else _text_cameras)(folder / f"cameras{suffix}")
    views = {}
    for name, pose, number in (_binary_images if binary else _text_images)(path):
        quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
        if number not in cameras:
            raise InputError(f"{path} has {name!r} of camera {number}; cameras{suffix} has no such camera")
        if not np.isfinite(pose).all() or abs(np.linalg.norm(quaternion) - 1) > 0.01:
            raise InputError(f"{path} has an invalid pose of {name!r}; expected a quaternion of length 1")
        rotation = scipy.spatial.transform.Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        views[name] = ColmapView(*cameras[number], np.column_stack([rotation, translation]))
    return views


def count_points(path: Path) -> int:
    """Return the number of points of a model, 0 without its file of points. Raises InputError for a broken file."""
    if not path.is_file():
        return 0
    with reading(path), path.open("rb") as file:
        if path.suffix == ".bin":
            start = file.read(struct.calcsize("<Q"))
            return struct.unpack("<Q", start)[0] if len(start) == struct.calcsize("<Q") else 0
        return sum(1 for line in file if line.strip() and not line.startswith(b"#"))


def _camera(path: Path, kind: str, width: int, height: int, values: Sequence[float]) -> _Camera:
    focal, _ = MODELS[kind]
    if not 0 < min(width, height) <= max(width, height) <= _MOST_SIDE:
        size = one_line(f"{width} x {height}", 60)
        raise InputError(f"{path} has a camera of {size} pixels; expected sides of 1 to {_MOST_SIDE}")
    fx, fy, (cx, cy) = values[0], values[focal - 1], values[focal : focal + 2]
    intrinsics = intrinsics_matrix(fx, fy, cx, cy, first_pixel=PIXEL_CENTRE, source=path)
    return intrinsics, (width, height), lens_of(kind, values, (width, height), path)


def _check_model(path: Path, kind: str) -> None:
    if kind not in MODELS:
        raise InputError(f"{path} has a camera of kind {one_line(kind, 40)}; expected one of {', '.join(MODELS)}")


def _binary_cameras(path: Path) -> Mapping[int, _Camera]:
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.next("<Q")[0]):
        number, model, width, height = reader.next("<iiQQ")
        kind = _NAMES[model] if 0 <= model < len(_NAMES) else str(model)
        _check_model(path, kind)
        cameras[number] = _camera(path, kind, width, height, reader.next(f"<{MODELS[kind][1]}d"))
    return cameras


def _text_cameras(path: Path) -> Mapping[int, _Camera]:
    cameras = {}
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            number, kind, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (ValueError, IndexError):
            raise InputError(f"{path} has {line[:80]!r}; expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from None
        _check_model(path, kind)
        if len(values) != MODELS[kind][1]:
            raise InputError(f"{path} has {len(values)} parameters of a {kind}; expected {MODELS[kind][1]}")
        cameras[number] = _camera(path, kind, width, height, values)
    return cameras


def _binary_images(path: Path) -> Iterator[tuple[str, list[float], int]]:
    """Yield name, quaternion (w first) with translation, and number of the camera of each image."""
    reader = _Reader(path)
    for _ in range(reader.next("<Q")[0]):
        _, *pose, camera = reader.next("<i7di")
        name = reader.text()
        reader.skip(_POINT_BYTES * reader.next("<Q")[0])
        yield name, pose, camera


def _text_images(path: Path) -> Iterator[tuple[str, list[float], int]]:
    """Yield what `_binary_images` yields; of two lines an image the second has its points, and may be empty."""
    for line in _lines(path)[::2]:
        words = line.split(maxsplit=_IMAGE_WORDS - 1)
        if not words:
            continue
        try:
            pose, camera, name = [float(word) for word in words[1:8]], int(words[8]), words[9].strip()
        except (ValueError, IndexError):
            message = f"{path} has {line[:80]!r}; expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise InputError(f"{message}, and a line of points after it") from None
        yield name, pose, camera


def _lines(path: Path) -> list[str]:
    """Return the lines of a text file from the first one on that is neither empty nor a comment."""
    lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
    first = next((number for number, line in enumerate(lines) if line.strip()), len(lines))
    return lines[first:]


class _Reader:
    """Reads records from a file one after the other, and never past its end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data = read_bytes(path)
        self._at = 0

    def next(self, layout: str) -> tuple[Any, ...]:
        start = self._at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._data, start)

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise InputError(f"{self.path} ends in the middle of a name; get it whole")
        name = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return name

    def skip(self, count: int) -> None:
        if count > len(self._data) - self._at:
            raise InputError(f"{self.path} ends after {len(self._data)} bytes, in the middle of a record; get it whole")
        self._at += count
