"""Coloured point clouds of a result, and PLY files, written in pieces: a clip at its source's size outgrows memory."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from vggtjax.results.frame import LeastConfidence, ResultFrame
from vggtjax.results.result import Result
from vggtjax.storage.arrays import spread_frames

_VERTEX = np.dtype([("points", "<f4", 3), ("colors", "u1", 3), ("alpha", "u1")])
_PROPERTIES = {
    "points": "float x y z",
    "normals": "float nx ny nz",
    "colors": "uchar red green blue",
    "alpha": "uchar alpha",
}


def ply_header(vertex: np.dtype, count: int) -> bytes:
    """Return the header of a binary PLY file of `count` vertices, whose fields are points, normals, colors or alpha."""
    rows = (_PROPERTIES[field].split() for field in vertex.names or ())
    properties = [f"property {kind} {name}" for kind, *names in rows for name in names]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header", ""]
    return "\n".join(lines).encode()


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the world and their sRGB colours."""

    points: Float32[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]

    def __len__(self) -> int:
        return len(self.points)


def least_confidence(
    result: Result, confidence_percentile: float, dynamic_percentile: float | None = None
) -> LeastConfidence:
    """Return the confidence that `confidence_percentile` percent of the clip's valid pixels do not reach.

    Static and dynamic pixels have a percentile each, over all frames at the model's size: fused confidence is the sum
    of two passes in static pixels and of one in dynamic pixels, so a common percentile would remove moving points.
    `dynamic_percentile` is another share for the dynamic ones.
    """

    confidence, valid, moving = spread_frames(result.depth_confidence, result.valid_pixels, result.dynamic_mask)

    def percentile(pixels: Bool[np.ndarray, "S H W"], share: float) -> float:
        return float(np.percentile(confidence[pixels], share)) if pixels.any() else 0.0

    share = confidence_percentile if dynamic_percentile is None else dynamic_percentile
    return LeastConfidence(percentile(valid & ~moving, confidence_percentile), percentile(valid & moving, share))


def frame_cloud(frame: ResultFrame, pixels: Bool[np.ndarray, "h w"]) -> PointCloud:
    """Return the points of the chosen pixels of a frame, but for points too far away for float32."""
    points = frame.world_points()[pixels]
    finite = np.isfinite(points).all(axis=-1)
    return PointCloud(points[finite], frame.image[pixels][finite])


class PlyWriter:
    """A context that writes a PLY file of float32 positions and 8-bit sRGB colours; the file is whole at its end."""

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
        if kind is None:  # the header holds the number of points, so it is written last
            with self._path.open("wb") as file, self._body.open("rb") as body:
                file.write(ply_header(_VERTEX, self._count))
                shutil.copyfileobj(body, file, 1 << 20)
        self._body.unlink(missing_ok=True)


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a cloud, which may be empty, as one file."""
    with PlyWriter(path) as ply:
        ply.add(cloud)
