"""What a user of the app gets of a result: viewer, films, sheet, and a zip of everything."""

from __future__ import annotations

import zipfile
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

if TYPE_CHECKING:
    from vggtjax.reconstruction import Reconstruction

_FILM_SECONDS, _FILM_RATE, _FILM_SIZE = 4.0, 15.0, (640, 360)  # drawn in seconds; `vggtjax render` draws larger ones
_CLIP_RATE = 8.0  # frames per second of clips without times
_RATES = (2.0, 30.0)
_LEAST_WIDTH, _GAP = 480, 4  # pixels of the layers' pictures, and between them
_COMPRESSED = (".ply", ".npy", ".txt", ".html", ".glb")  # all others are compressed already


@dataclass(frozen=True)
class Outputs:
    """Files that the browser shows or downloads, and a line about the result."""

    viewer: Path
    film: Path
    layers: Path
    sheet: Path
    report: Path
    archive: Path
    facts: str
    note: str  # a warning about the model, or nothing


def write_outputs(result: Reconstruction, folder: Path, name: str, on_stage: OnStage) -> Outputs:
    """Write everything that is shown into `folder`; the archive is named `name`."""
    saved = folder / name
    with on_stage("write files") as progress:
        result.save(saved, progress=progress)
    with on_stage("viewer"):
        viewer = saved / "viewer.html"
        viewer.write_text(viewer_page([result]), encoding="utf-8")
    with on_stage("film") as progress:
        film = saved / "film.mp4"
        frames = film_frames(result, seconds=_FILM_SECONDS, fps=_FILM_RATE, size=_FILM_SIZE, progress=progress)
        write_film(film, frames, _FILM_RATE)
    with on_stage("layers") as progress:
        layers = saved / "layers.mp4"
        write_film(layers, layer_frames(result, progress), clip_rate(result))
    with on_stage("zip") as progress:
        archive = folder / f"{name}.zip"
        write_zip(archive, saved, progress)
    frames, height, width = result.depth.shape
    facts = f"{frames} frames of {width} x {height} pixels, {result.dynamic_share:.1%} of them moving"
    return Outputs(
        viewer, film, layers, saved / "preview" / "sheet.png", saved / "report.html", archive, facts, result.model_note
    )


def layer_frames(result: Reconstruction, progress: Progress | None = None) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield, for each frame, picture, depth, confidence and moving objects, two by two, with even sides."""
    S, H, W = result.depth.shape
    scale = max(1.0, _LEAST_WIDTH / W)
    size = round(W * scale / 2) * 2, round(H * scale / 2) * 2
    valid = result.valid_pixels
    inverse_range = previews.inverse_depth_range(result.depth, valid)
    confidence = _ranks(result.depth_confidence, valid)
    for frame in range(S):
        picture = Image.fromarray(result.images[frame]).resize(size, Image.Resampling.LANCZOS)
        depth = previews.color_depth(result.depth[frame], valid[frame], inverse_range)
        moving = Image.fromarray(previews.moving_ids(result.dynamic_mask[frame], result.instances[frame]))
        outlined = previews.overlay(np.asarray(picture), np.asarray(moving.resize(size, Image.Resampling.NEAREST)))
        tiles = [picture, Image.fromarray(depth), Image.fromarray(confidence[frame]), Image.fromarray(outlined)]
        sheet = Image.new("RGB", (2 * size[0] + _GAP, 2 * size[1] + _GAP), previews.BACKGROUND)
        for number, tile in enumerate(tiles):
            across, down = number % 2 * (size[0] + _GAP), number // 2 * (size[1] + _GAP)
            sheet.paste(tile.resize(size, Image.Resampling.LANCZOS), (across, down))
        yield np.asarray(sheet)
        (progress or no_progress)(frame + 1, S)


def clip_rate(result: Reconstruction) -> float:
    """Return the frames per second at which the clip plays as fast as the world moved, within what players show."""
    times = result.timestamps
    if times is None or len(times) < 2 or times[-1] <= times[0]:
        return _CLIP_RATE
    return float(np.clip((len(times) - 1) / (times[-1] - times[0]), *_RATES))


def write_zip(path: Path, folder: Path, progress: Progress | None = None) -> None:
    """Write all files of a folder, under the folder's name."""
    files = sorted(file for file in folder.rglob("*") if file.is_file() and not file.name.startswith("."))
    with zipfile.ZipFile(path, "w", compresslevel=1) as archive:
        for done, file in enumerate(files, 1):
            kind = zipfile.ZIP_DEFLATED if file.suffix in _COMPRESSED else zipfile.ZIP_STORED
            archive.write(file, Path(folder.name) / file.relative_to(folder), compress_type=kind)
            (progress or no_progress)(done, len(files))


def _ranks(values: np.ndarray, valid: np.ndarray) -> UInt8[np.ndarray, "S H W"]:
    """Return the share of the clip's valid pixels with a lower value, from 0 to 255; 0 where invalid."""
    edges = np.quantile(values[valid], np.linspace(0, 1, 256)) if valid.any() else np.zeros(1)
    return np.where(valid, np.searchsorted(edges, np.nan_to_num(values)).clip(0, 255), 0).astype(np.uint8)
