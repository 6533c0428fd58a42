"""Point clouds as PLY files, written piece by piece: a clip at its source's size is more than fits in memory."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from vggtjax.results.point_cloud import PointCloud

_VERTEX = np.dtype([("points", "<f4", 3), ("colors", "u1", 3), ("alpha", "u1")])
_HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property uchar alpha
end_header
"""


class PlyWriter:
    """A PLY file of float32 positions and 8-bit sRGB colours in the making; a context, at whose end it is there."""

    def __init__(self, path: Path) -> None:
        self._path, self._body = path, path.with_name(f"{path.name}.points")
        self._count = 0

    def __enter__(self) -> PlyWriter:
        self._file = self._body.open("wb")
        return self

    def add(self, cloud: PointCloud) -> None:
        """Append points."""
        vertices = np.empty(len(cloud), _VERTEX)
        vertices["points"], vertices["colors"], vertices["alpha"] = cloud.points, cloud.colors, 255
        self._file.write(vertices.data)
        self._count += len(cloud)

    def __exit__(self, kind: type | None, *_: object) -> None:
        self._file.close()
        if kind is None:  # the header says how many there are, so it comes last
            with self._path.open("wb") as file, self._body.open("rb") as body:
                file.write(_HEADER.format(count=self._count).encode())
                shutil.copyfileobj(body, file, 1 << 20)
        self._body.unlink(missing_ok=True)


def write_ply(path: Path, clouds: Iterable[PointCloud]) -> None:
    """Write clouds as one file; it may be empty."""
    with PlyWriter(path) as ply:
        for cloud in clouds:
            ply.add(cloud)
