"""The table of export formats. Imports neither numpy nor the formats' libraries."""

from __future__ import annotations

from typing import Literal, NamedTuple

ExportFormat = Literal[
    "colmap", "colmap-text", "gsplat", "nerfstudio", "rerun", "glb-animated", "exr", "tum", "kitti"
]


class Format(NamedTuple):
    """What a format needs."""

    extra: str | None  # of the installation
    modules: tuple[str, ...] = ()
    suffix: str = ""  # of its one file; empty for a folder


FORMATS: dict[ExportFormat, Format] = {
    "colmap": Format("colmap", ("pycolmap",)),
    "colmap-text": Format("colmap", ("pycolmap",)),
    "gsplat": Format("colmap", ("pycolmap",)),
    "nerfstudio": Format(None),
    "rerun": Format("rerun", ("rerun",), ".rrd"),
    "glb-animated": Format(None, (), ".glb"),
    "exr": Format("exr", ("OpenEXR",)),
    "tum": Format(None, (), ".txt"),
    "kitti": Format(None, (), ".txt"),
}
