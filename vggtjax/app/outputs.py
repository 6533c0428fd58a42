"""What a user of the app gets of a result: viewer, films, sheet, and a zip of everything."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vggtjax.progress import OnStage, Progress, no_progress
from vggtjax.results import previews
from vggtjax.results.films import film_frames, write_film
from vggtjax.viewer.page import viewer_page
from vggtjax.viewer.scene import frame_rate

if TYPE_CHECKING:
    from vggtjax.reconstruction import Reconstruction

_FILM_SECONDS, _FILM_RATE, _FILM_SIZE = 4.0, 15.0, (640, 360)  # drawn in seconds; `vggtjax render` draws larger ones


@dataclass(frozen=True)
class Outputs:
    """Files that the browser shows or downloads, and a line about the result."""

    viewer: Path
    film: Path
    layers: Path
    sheet: Path
    report: Path
    archive: Path
    megabytes: float  # of the archive
    facts: str
    note: str  # a warning about the model, or nothing


def write_outputs(result: Reconstruction, folder: Path, name: str, on_stage: OnStage) -> Outputs:
    """Write everything that is shown into `folder`; the archive is named `name`."""
    saved = folder / name
    with on_stage("write files") as progress:
        result.save(saved, progress=progress)
    viewer, film, layers = (saved / file for file in ("viewer.html", "film.mp4", "layers.mp4"))
    with on_stage("viewer"):
        viewer.write_text(viewer_page([result]), encoding="utf-8")
    with on_stage("film") as progress:
        frames = film_frames(result, seconds=_FILM_SECONDS, fps=_FILM_RATE, size=_FILM_SIZE, progress=progress)
        write_film(film, frames, _FILM_RATE)
    with on_stage("layers") as progress:
        write_film(layers, _layers(result, progress), frame_rate(result))
    with on_stage("zip"):
        archive = Path(shutil.make_archive(str(saved), "zip", root_dir=folder, base_dir=name))
    frames, height, width = result.depth.shape
    moving = f", {result.dynamic_share:.1%} of them moving" if result.has_mask else ""
    facts = f"{frames} frames of {width} x {height} pixels{moving}"
    sheet, report, megabytes = saved / "preview" / "sheet.png", saved / "report.html", archive.stat().st_size / 1e6
    return Outputs(viewer, film, layers, sheet, report, archive, megabytes, facts, result.model_note)


def _layers(result: Reconstruction, progress: Progress | None) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield, for each frame, picture, depth, confidence and moving objects, two by two."""
    valid, size = result.valid_pixels, previews.enlarged(result.depth.shape[1:])
    inverse_range = previews.inverse_depth_range(result.depth, valid)
    log_range = previews.log_confidence_range(result.depth_confidence, valid)
    for frame, picture in enumerate(result.images):
        moving = previews.moving_ids(result.dynamic_mask[frame], result.instances[frame])
        confidence = previews.color_confidence(result.depth_confidence[frame], valid[frame], log_range)
        large, sure = (np.asarray(Image.fromarray(each).resize(size)) for each in (picture, confidence))
        depth = previews.depth_picture(result.depth[frame], valid[frame], inverse_range)
        yield np.vstack([np.hstack([large, depth]), np.hstack([sure, previews.overlay_picture(picture, moving)])])
        (progress or no_progress)(frame + 1, len(valid))
