"""The command `vggtjax export`. Does not import jax."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from vggtjax.interface.commands.arguments import ResultPath
from vggtjax.interface.commands.report import Report
from vggtjax.results.exports.table import ExportFormat, Exporting


def export(
    result: ResultPath,
    /,
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")],
    *,
    to: Annotated[ExportFormat, tyro.conf.arg(metavar="FORMAT")],
    pictures: Annotated[str | None, tyro.conf.arg(metavar="SOURCE", help_behavior_hint="")] = None,
    exporting: Annotated[Exporting, tyro.conf.arg(name="points")] = Exporting(),
) -> None:
    """Write a result for COLMAP, nerfstudio, gsplat, rerun, Blender, glTF, OpenEXR, TUM or KITTI, or as a mesh.

    Args:
        result: the folder of a result.
        out: folder or file to write; it must not exist.
        to: one of colmap, colmap-text, gsplat, nerfstudio, dynamic-splats, rerun, blender, glb-animated, mesh, exr,
            tum, kitti.
        pictures: the source that the result was made from, to write pictures, depth and cameras at its size; by default
            those of the model's size are written.
        exporting: the points
    """
    report = Report()
    with report.running():
        from vggtjax.results.exports.write import check_export, export_result

        check_export(out, to, pictures=pictures is not None)
        from vggtjax.results.reconstruction import Reconstruction

        with report.stage("read"):
            loaded = Reconstruction.load(result)
        source = None
        if pictures is not None:
            from vggtjax.clips.sources import open_source

            source = open_source(pictures, undistort="undistorted" in loaded.settings)
        with report.stage("write") as progress:
            export_result(loaded, out, to, source=source, exporting=exporting, progress=progress)
    report.line(f"{to}: {out}")
