"""What a user of the app gets of a result: viewer, films, sheet, report, and a zip of everything."""

from __future__ import annotations

import shutil
from pathlib import Path

from vggtjax.progress import OnStage
from vggtjax.results.films import film_frames, write_film
from vggtjax.results.previews import layer_frames
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.viewer.page import viewer_page
from vggtjax.results.viewer.scene import playing_rate

_FILM_SECONDS, _FILM_RATE, _FILM_SIZE = 4.0, 15.0, (640, 360)  # drawn in seconds; `vggtjax render` draws larger ones


def write_outputs(result: Reconstruction, saved: Path, on_stage: OnStage) -> tuple[str, list[Path], list[Path]]:
    """Write a result into the folder `saved`, and a zip beside it; where that fails, leave nothing.

    Returns a line about it, what the page shows (viewer, film, layers, sheet), and what it offers as files.
    """
    viewer, film, layers = (saved / file for file in ("viewer.html", "film.mp4", "layers.mp4"))
    shown = [viewer, film, layers, saved / "preview" / "sheet.png"]
    try:
        with on_stage("write files") as progress:
            result.save(saved, progress=progress)
        with on_stage("viewer"):
            viewer.write_text(viewer_page([result]), encoding="utf-8")
        with on_stage("film") as progress:
            frames = film_frames(result, seconds=_FILM_SECONDS, fps=_FILM_RATE, size=_FILM_SIZE, progress=progress)
            write_film(film, frames, _FILM_RATE)
        with on_stage("layers") as progress:
            write_film(layers, layer_frames(result, progress), playing_rate(result))
        with on_stage("zip"):
            archive = Path(shutil.make_archive(str(saved), "zip", root_dir=saved.parent, base_dir=saved.name))
    except BaseException:
        shutil.rmtree(saved.parent, ignore_errors=True)
        raise
    for path in {path for path in saved.rglob("*") if path.is_file()} - {*shown}:
        path.unlink()  # the zip has it
    count, height, width = result.depth.shape
    moving = f", {result.dynamic_share:.1%} of them moving" if result.has_mask else ""
    facts = f"**Done**: {count} frames of {width} x {height} pixels{moving}.\n\n{result.model_note}"
    return facts, shown, [archive, viewer, film]
