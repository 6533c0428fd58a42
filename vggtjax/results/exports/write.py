"""Writing a result in another program's format, as a whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np

from vggtjax.clips.media.sampling import Source
from vggtjax.errors import InputError, OutputError, check_choice, check_extra
from vggtjax.progress import Progress, no_progress
from vggtjax.results.exports.names import picture_names, safe_names, say_renamed
from vggtjax.results.exports.table import FORMATS, ExportFormat, Exporting
from vggtjax.results.exports.views import View, views
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result
from vggtjax.results.shown import POINT_LIMIT, shown_points
from vggtjax.storage.trajectories import write_trajectory
from vggtjax.storage.writing import writing

_MOSTLY = 0.5  # share of moving pixels from which a mask may be the wrong way round


def check_export(out: Path, form: ExportFormat, *, pictures: bool = False) -> None:
    """Check what can be checked before the result is read.

    Raises InputError for an unknown format or a wrong suffix, MissingExtraError, and OutputError where `out` exists.
    """
    check_choice("format", form, get_args(ExportFormat))
    needs = FORMATS[form]
    if pictures and not needs.has_pictures:
        raise InputError(f"{form} has no pictures, and is made at the model's size; leave --pictures out")
    if needs.extra:
        check_extra(f"the format {form}", needs.extra, *needs.modules)
    if needs.suffixes and out.suffix.lower() not in needs.suffixes:
        ends = " or ".join(needs.suffixes)
        raise InputError(f"{out} is one file of the format {form}; give it a name that ends with {ends}")
    if os.path.lexists(out) and not (out.is_dir() and not needs.suffixes and not any(out.iterdir())):
        raise OutputError(f"{out} exists and is not replaced; choose another name, or move it away")


def export_result(
    result: Result,
    out: str | Path,
    form: ExportFormat,
    *,
    source: Source | None = None,
    exporting: Exporting = Exporting(),
    progress: Progress | None = None,
) -> None:
    """Write a result in another program's format.

    Args:
        result: of a clip.
        out: the folder or file, which must not exist; a folder may be empty.
        form: the format.
        source: the clip's pictures, from `open_source`, for an export at their size; by default the model's size.
        exporting: the points, and the voxels of a mesh.
        progress: called with the number of frames done, and of all.

    Raises:
        InputError: an unknown format, a name without the format's suffix, or a mesh that is too fine or of nothing.
        MissingExtraError: the format's library is not installed.
        ClipError: the source lacks a frame of the result, or has pictures of another size.
        OutputError: `out` exists or cannot be written.
    """
    out = Path(out)
    check_export(out, form)
    with writing(out) as path:
        if not FORMATS[form].suffixes:
            path.mkdir()
        wanted = picture_names(result, source)
        names = safe_names(wanted, blanks=form != "colmap-text")
        if FORMATS[form].has_names:
            say_renamed(path, wanted, names)
        items = _counted(views(result, source, names), len(result.depth), progress)
        _write(result, path, form, items, exporting, progress)
        if out.is_dir():  # and empty, as it was checked; Windows renames nothing onto a folder
            out.rmdir()


def _write(
    result: Result,
    path: Path,
    form: ExportFormat,
    items: Iterator[View],
    exporting: Exporting,
    progress: Progress | None,
) -> None:
    match form:
        case "colmap" | "colmap-text" | "gsplat":
            from vggtjax.results.exports.colmap import write_colmap

            static = _static(result, form, exporting)
            write_colmap(path, items, result, static, "text" if form == "colmap-text" else "binary")
        case "nerfstudio":
            from vggtjax.results.exports.nerfstudio import write_nerfstudio

            write_nerfstudio(path, items, _static(result, form, exporting))
        case "rerun":
            from vggtjax.results.exports.rerun import write_rerun

            write_rerun(path, items, *_clouds(result, exporting))
        case "glb-animated":
            from vggtjax.results.exports.animated_glb import write_animated_glb

            most_moving = min(exporting.points, POINT_LIMIT // len(result.depth))
            write_animated_glb(path, result, *_clouds(result, exporting, most_moving))
        case "dynamic-splats":
            from vggtjax.results.exports.dynamic_splats import write_dynamic_splats

            write_dynamic_splats(path, items, result, *_clouds(result, exporting))
        case "blender":
            from vggtjax.results.exports.blender import write_blender

            write_blender(path, items, result, *_clouds(result, exporting))
        case "mesh":
            from vggtjax.results.exports.mesh import write_mesh

            write_mesh(path, result, exporting, progress)
        case "exr":
            from vggtjax.results.exports.exr import write_exr

            write_exr(path, items)
        case "tum":
            write_trajectory(path, result.world_from_camera, result.file_time_texts, note=result.model_note)
        case "kitti":
            poses = result.world_from_camera[:, :3].reshape(-1, 12).astype(np.float64)
            np.savetxt(path, poses, fmt="%.9g", encoding="utf-8")


def _clouds(
    result: Result, exporting: Exporting, most_moving: int | None = None
) -> tuple[PointCloud, list[PointCloud]]:
    """Return the static points, and the moving ones of each frame. Raises InputError where there is no point."""
    percentile = exporting.confidence_percentile
    static, moving = shown_points(
        result,
        static_percentile=percentile,
        dynamic_percentile=percentile,
        most_static=exporting.points,
        most_moving=exporting.points if most_moving is None else most_moving,
    )
    if not len(static.positions) + sum(len(points.positions) for points in moving):
        seen = "is sure of its depth and off the edges of surfaces" if (result.depth > 0).any() else "has a depth"
        raise InputError(f"the result has no point: no pixel {seen}; run again, and look at its report.html first")
    return static.cloud(result), [points.cloud(result) for points in moving]


def _static(result: Result, form: ExportFormat, exporting: Exporting) -> PointCloud:
    """Return the static points. Raises InputError without any: no program could use such a model."""
    static, _ = _clouds(result, exporting)
    if not len(static):
        why = (
            f"{result.dynamic_share:.0%} of its pixels move; are the masks the wrong way round (white is what moves)?"
            if result.has_mask and result.dynamic_share > _MOSTLY
            else "no pixel that stands still is sure of its depth; look at its report.html"
        )
        raise InputError(f"{form} has the static points of a result, and this one has none: {why}")
    return static


def _counted(items: Iterator[View], count: int, progress: Progress | None) -> Iterator[View]:
    for number, view in enumerate(items, start=1):
        yield view
        (progress or no_progress)(number, count)
