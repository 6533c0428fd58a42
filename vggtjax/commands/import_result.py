"""What `vggtjax import` does: the result of another project, read and written as ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.commands.report import Report


def import_result(
    source: tyro.conf.Positional[Path],
    /,
    out: Path,
    *,
    layout: Annotated[Literal["vggt4d", "monst3r", "cut3r", "da3"], tyro.conf.arg(name="format")],
    quaternion: Literal["xyzw", "wxyz"] | None = None,
    confidence_percentile: float = 20.0,
) -> None:
    """Read the result folder of another project, and write it as ours: pictures, clouds, a scene to look at.

    Args:
        source: the folder.
        out: folder for our files; an earlier result in it is replaced.
        layout: whose it is.
        quaternion: order of the quaternions in pred_traj.txt: wxyz as MonST3R and VGGT4D write it, or xyzw.
        confidence_percentile: leave so many percent of the pixels, the least confident, out of the point clouds.
    """
    report = Report()
    with report.running():
        from vggtjax.results.folder import check_folder
        from vggtjax.results.point_cloud import check_percentile
        from vggtjax.results.reconstruction import Reconstruction

        check_percentile(confidence_percentile)
        check_folder(out)
        with report.stage("read"):
            result = Reconstruction.load(source, layout=layout, quaternion=quaternion)
        with report.stage("write") as progress:
            result.save(out, confidence_percentile=confidence_percentile, progress=progress)
    report.summary(result, out, trained=True)
