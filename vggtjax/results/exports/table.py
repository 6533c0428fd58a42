"""The table of export formats, and the options. Imports neither numpy nor the formats' libraries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta

from vggtjax.storage.json_values import check_fields

ExportFormat = Literal[
    "colmap",
    "colmap-text",
    "gsplat",
    "nerfstudio",
    "rerun",
    "glb-animated",
    "dynamic-splats",
    "blender",
    "mesh",
    "exr",
    "tum",
    "kitti",
]


class Format(NamedTuple):
    """What a format needs."""

    extra: str | None  # of the installation
    modules: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()  # of its one file; none for a folder
    has_pictures: bool = True  # or maps, at the size of the source where that is given
    has_names: bool = False  # files of frames have the names of the source's


FORMATS: dict[ExportFormat, Format] = {
    "colmap": Format("colmap", ("pycolmap",), has_names=True),
    "colmap-text": Format("colmap", ("pycolmap",), has_names=True),
    "gsplat": Format("colmap", ("pycolmap",), has_names=True),
    "nerfstudio": Format(None, has_names=True),
    "rerun": Format("rerun", ("rerun",), (".rrd",)),
    "glb-animated": Format(None, (), (".glb",), has_pictures=False),
    "dynamic-splats": Format(None),
    "blender": Format(None),
    "mesh": Format(None, (), (".glb", ".ply"), has_pictures=False),
    "exr": Format("exr", ("OpenEXR",), has_names=True),
    "tum": Format(None, (), (".txt",), has_pictures=False),
    "kitti": Format(None, (), (".txt",), has_pictures=False),
}


@dataclass(frozen=True)
class Exporting:
    """Which points an export holds, and how fine a mesh is. Raises InputError for a value out of range.

    Attributes:
        points: write at most this many static points, and at most this many moving points in each frame
        confidence_percentile: leave out this percentage of the pixels, those of the lowest confidence, from the points
            or the mesh; at least 0 and less than 100
        voxel_size: edge of the voxels of a mesh, in units of the result; by default as wide as a pixel on the surfaces,
            or wider where the frames differ by more
    """

    points: Annotated[int, Meta(ge=1)] = 100_000
    confidence_percentile: Annotated[float, Meta(ge=0, lt=100)] = 20.0
    voxel_size: Annotated[float, Meta(ge=1e-30, le=1e9)] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
