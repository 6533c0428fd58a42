"""The command `vggtjax import`. Does not import jax before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from vggtjax.interface.commands.arguments import QuaternionOrder
from vggtjax.interface.commands.report import Report
from vggtjax.results.saving import ForeignFormat, Saving


def import_result(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    /,
    out: Path,
    *,
    format: ForeignFormat,
    quaternion: QuaternionOrder = None,
    confidence_percentile: float = 20.0,
) -> None:
    """Read the result folder of another project, and write it as ours: pictures, clouds, a scene to look at.

    Args:
        source: the folder.
        out: folder for our files; an earlier result in it is replaced.
        format: the program whose files the folder has.
        quaternion: order of the quaternions in pred_traj.txt.
        confidence_percentile: leave out this percentage of the pixels, those of the lowest confidence, from the point
            clouds; at least 0 and less than 100.
    """
    saving = Saving(confidence_percentile=confidence_percentile)
    report = Report()
    with report.running():
        from vggtjax.results.folder import check_folder
        from vggtjax.results.reconstruction import Reconstruction

        check_folder(out)
        with report.stage("read"):
            result = Reconstruction.load(source, format=format, quaternion=quaternion)
        with report.stage("write") as progress:
            result.save(out, saving=saving, progress=progress)
    report.summary(result, out)
