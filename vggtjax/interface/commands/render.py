"""The command `vggtjax render`. Does not import jax."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.errors import InputError, OutputError
from vggtjax.interface.commands.arguments import Overwrite, QuaternionOrder, ResultPath
from vggtjax.interface.commands.report import Report
from vggtjax.results.saving import ReadFormat
from vggtjax.storage.writing import check_file

_FILM = "turntable.mp4"


def render(
    result: ResultPath,
    /,
    *,
    path: Literal["orbit", "camera"] = "orbit",
    seconds: float = 6.0,
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "960x540",
    fps: float = 24.0,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILM", help_behavior_hint="")] = None,
    overwrite: Overwrite = False,
    format: ReadFormat = "vggtjax",
    quaternion: QuaternionOrder = None,
) -> None:
    """Draw a result's points as a film: the static background stays, what moves plays.

    Args:
        result: folder of a result.
        path: orbit swings around the scene, camera follows the filming camera.
        seconds: length of the film, in seconds; at most 10000 frames.
        size: width x height in pixels, each from 16 to 4096.
        fps: frames per second, up to 120, for a .gif up to 50.
        out: the film, an .mp4, .gif or .webp; by default RESULT/preview/turntable.mp4, or RESULT/turntable.mp4 without
            a folder preview; the default file is replaced without --overwrite.
        overwrite: replace the file if it exists.
        format: the program whose files the folder has.
        quaternion: order of the quaternions in pred_traj.txt.
    """
    sides = _sides(size)
    report = Report()
    with report.running():
        from vggtjax.results.films import film_frames, write_film
        from vggtjax.results.folder import check_no_part
        from vggtjax.results.reconstruction import Reconstruction
        from vggtjax.results.rendering.film import check_film

        folder = result.parent if result.is_file() else result
        previews = folder / "preview"  # which the next result replaces
        film = out or (previews if previews.is_dir() else folder) / _FILM
        check_film(film, fps)
        check_file(film, overwrite=overwrite or out is None, sources=[result])
        if out is not None:
            check_no_part([film], result, what="no film replaces it; choose another name", foreign=format != "vggtjax")
        with report.stage("read"):
            loaded = Reconstruction.load(result, format=format, quaternion=quaternion)
        if not film.parent.is_dir():
            raise OutputError(f"there is no folder {film.parent} for the film; make it, or choose another --out")
        with report.stage("draw") as progress:
            frames = film_frames(loaded, path=path, seconds=seconds, fps=fps, size=sides, progress=progress)
            write_film(film, frames, fps)
    report.table({"film": film})
    if loaded.model_note:
        report.line(f"The model: {loaded.model_note}")


def _sides(size: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", size)
    if match is None:
        raise InputError(f"size is {size!r}; expected width x height, such as 960x540")
    return int(match[1]), int(match[2])
