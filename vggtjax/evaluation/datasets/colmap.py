"""Cameras of a COLMAP model: cameras.bin and images.bin. Does not import jax.

The layout is that of COLMAP's documentation (https://colmap.github.io/format.html) and of its `Reconstruction`, which
writes the binary form: little-endian, a count of 64 bits, then the records. COLMAP puts the outer corner of the first
pixel at (0, 0), as this library does.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.cameras import PIXEL_CENTRE, intrinsics_matrix
from vggtjax.evaluation.datasets.folders import read_bytes

# Camera models by COLMAP's numbers: numbers of focal lengths and of all parameters; the principal point follows the
# focal lengths. Without fisheye models: K alone does not describe their cameras.
_MODELS = {
    0: (1, 3),  # SIMPLE_PINHOLE
    1: (2, 4),  # PINHOLE
    2: (1, 4),  # SIMPLE_RADIAL
    3: (1, 5),  # RADIAL
    4: (2, 8),  # OPENCV
    6: (2, 12),  # FULL_OPENCV
}
_POINT_BYTES = 24  # of an observation in images.bin: x, y, the point's number


class ColmapView(NamedTuple):
    """A registered image: its camera in pixels, the size of its picture, and its pose."""

    intrinsics: Float64[np.ndarray, "3 3"]
    size: tuple[int, int]  # width, height
    distorted: bool  # the lens has a distortion, which the intrinsics lack
    camera_from_world: Float64[np.ndarray, "3 4"]


def read_views(folder: Path) -> dict[str, ColmapView]:
    """Return the registered images of a model by name.

    Raises InputError for files that end early, other camera models, and invalid cameras.
    """
    cameras = _read_cameras(folder / "cameras.bin")
    reader = _Reader(folder / "images.bin")
    views = {}
    for _ in range(reader.next("<Q")[0]):
        _, *pose, camera = reader.next("<i7di")
        name = reader.text()
        reader.skip(_POINT_BYTES * reader.next("<Q")[0])
        quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
        if camera not in cameras:
            raise InputError(f"{reader.path} has {name!r} of camera {camera}; cameras.bin has no such camera")
        if not np.isfinite(pose).all() or abs(np.linalg.norm(quaternion) - 1) > 0.01:
            raise InputError(f"{reader.path} has an invalid pose of {name!r}; expected a quaternion of length 1")
        rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        views[name] = cameras[camera](np.column_stack([rotation, translation]))
    return views


def _read_cameras(path: Path) -> dict[int, Callable[[Float64[np.ndarray, "3 4"]], ColmapView]]:
    """Return by number the cameras of a model as functions from a pose to a view."""
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.next("<Q")[0]):
        number, kind, width, height = reader.next("<iiQQ")
        if kind not in _MODELS:
            raise InputError(f"{path} has a camera of kind {kind}; expected one of {', '.join(map(str, _MODELS))}")
        focal, parameters = _MODELS[kind]
        values = reader.next(f"<{parameters}d")
        fx, fy = values[0], values[focal - 1]
        cx, cy = values[focal : focal + 2]
        if not width or not height:
            raise InputError(f"{path} has a camera of {width} x {height} pixels; expected sizes above 0")
        intrinsics = intrinsics_matrix(fx, fy, cx, cy, first_pixel=PIXEL_CENTRE, source=path)
        cameras[number] = partial(ColmapView, intrinsics, (width, height), any(values[focal + 2 :]))
    return cameras


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
