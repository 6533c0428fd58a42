"""What known cameras and lengths do to the other errors: python -m benchmarks known."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.known_clips import KnownClip, clips_of_seed
from benchmarks.summaries import markdown_table, spread
from vggtjax.cameras import unproject, world_from_camera
from vggtjax.errors import InputError
from vggtjax.pipeline.known.apply import apply_known
from vggtjax.pipeline.known.depths import DepthSamples
from vggtjax.pipeline.known.given import Given
from vggtjax.pipeline.known.options import Baseline, KnownGeometry
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.research.evaluation.metrics.depth import depth_errors
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error, umeyama_sim3
from vggtjax.results.reconstruction import Reconstruction

_EVERY = 7  # pixels of a clip, for the points
_DEPTHS = 5  # known ones, in frame 0


class Errors(NamedTuple):
    """The errors of one clip."""

    focal: float  # percent
    rotation: float  # degrees
    centres: float  # RMSE after Sim(3), in median depths
    abs_rel: float  # after one median scale
    points: float  # mean distance after Sim(3), in median depths
    metric: float  # AbsRel without a scale: a unit of the network's counts as a metre unless a scale is known


HEADINGS = ("focal (%)", "rotation (deg)", "centres", "AbsRel", "points", "metric AbsRel")
NOTHING = "nothing"


def _poses(clip: KnownClip) -> np.ndarray:
    return world_from_camera(clip.camera_from_world.astype(np.float64))


def _distance(clip: KnownClip) -> Given:
    centres = _poses(clip)[:, :3, 3]
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    first, second = np.unravel_index(apart.argmax(), apart.shape)
    return Given(KnownGeometry(), baseline=Baseline(int(first), int(second), float(apart.max())))


def _depths(clip: KnownClip) -> Given:
    """Return the true depth of a few pixels of frame 0."""
    rows, columns = np.nonzero(clip.result.valid_pixels[0])
    chosen = np.linspace(0, len(rows) - 1, _DEPTHS).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    samples = DepthSamples(np.zeros_like(rows), rows, columns, clip.depth[0, rows, columns].astype(np.float64))
    return Given(KnownGeometry(), depths=samples)


def _intrinsics(clip: KnownClip) -> np.ndarray:
    return clip.intrinsics.astype(np.float64)


ROWS: dict[str, Callable[[KnownClip], Given]] = {
    NOTHING: lambda clip: Given(KnownGeometry()),
    "shared focal length": lambda clip: Given(KnownGeometry(shared_focal=True)),
    "intrinsics": lambda clip: Given(KnownGeometry(), intrinsics=_intrinsics(clip)),
    "poses": lambda clip: Given(KnownGeometry(), poses=_poses(clip)),
    "intrinsics and poses": lambda clip: Given(KnownGeometry(), intrinsics=_intrinsics(clip), poses=_poses(clip)),
    "a distance": _distance,
    "intrinsics and a distance": lambda clip: _distance(clip)._replace(intrinsics=_intrinsics(clip)),
    f"{_DEPTHS} depths": _depths,
}


def known(
    *,
    model: str = "demo",
    clips: int = 64,
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4),
    folder: Path = Path("known-clips"),
    workers: int = 1,
) -> None:
    """Bring predictions of generated clips to true cameras and lengths, and measure all errors.

    Half of the clips are static, half have moving objects. The network runs once for a clip.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        clips: number of clips of a seed.
        seeds: of the clips.
        folder: keeps clips and predictions; a later run with the same model takes them from there.
        workers: processes, each of which takes a seed at a time.
    """
    if clips < 2 or not seeds or workers < 1:
        raise InputError(
            f"clips is {clips}, seeds {seeds} and workers {workers}; expected at least 2 clips, a seed and a worker"
        )
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(partial(_of_seed, model, clips, folder), seeds))
    Console(width=200).print(_table(found), markup=False, highlight=False, soft_wrap=True)


def _of_seed(model: str, clips: int, folder: Path, seed: int) -> dict[str, list[Errors | str]]:
    logging.getLogger("vggtjax").setLevel(logging.ERROR)  # the true poses fit this model's predictions poorly
    found: dict[str, list[Errors | str]] = {name: [] for name in ROWS}
    made = clips_of_seed(load_model(model), seed, clips, folder)
    for clip in track(made, f"seed {seed}", clips, console=Console(stderr=True)):
        for name, given in ROWS.items():
            found[name].append(_measured(clip, given(clip)))
    return found


def _measured(clip: KnownClip, given: Given) -> Errors | str:
    try:
        result = apply_known(clip.result, given)[0]
    except InputError as error:
        return str(error)
    return errors_of(result, clip)


def errors_of(result: Reconstruction, clip: KnownClip) -> Errors:
    """Return the errors of a result of a clip."""
    unit = float(np.median(clip.depth))
    ratio = result.intrinsics[:, [0, 1], [0, 1]] / clip.intrinsics[:, [0, 1], [0, 1]]
    points, truth = (
        unproject(*(array.astype(np.float64) for array in arrays), pixel_offset=0.5).reshape(-1, 3)[::_EVERY]
        for arrays in (
            (result.depth, result.intrinsics, result.camera_from_world),
            (clip.depth, clip.intrinsics, clip.camera_from_world),
        )
    )
    return Errors(
        100 * float(np.abs(np.log(ratio)).mean()),
        rotation_error(result.camera_from_world, clip.camera_from_world),
        centre_error(result.camera_from_world, clip.camera_from_world) / unit,
        depth_errors(result.depth, clip.depth).abs_rel,
        float(np.linalg.norm(umeyama_sim3(points, truth).apply(points) - truth, axis=1).mean() / unit),
        depth_errors(result.depth, clip.depth, scale=1.0).abs_rel,
    )


def _table(seeds: list[dict[str, list[Errors | str]]]) -> str:
    """Return a markdown table: mean ± standard deviation over seeds, and the share of clips with a smaller error.

    A seed counts with the mean over its clips, in the last column with their median: a scale from a distance that is
    predicted to be close to 0 has no bound.
    """
    lines = []
    for name in seeds[0]:
        cells = []
        for column in range(len(HEADINGS)):
            average = np.median if column == len(HEADINGS) - 1 else np.mean
            pairs = [
                np.array(
                    [
                        (row[column], base[column])
                        for row, base in zip(seed[name], seed[NOTHING], strict=True)
                        if not isinstance(row, str) and not isinstance(base, str)
                    ]
                )
                for seed in seeds
            ]
            text = spread([float(average(rows[:, 0])) for rows in pairs]).text(4)
            value, base = np.concatenate(pairs).T
            changed = (np.abs(value - base) > 1e-6).any()
            cells.append(f"{text}, {100 * np.mean(value < base - 1e-9):.0f} %" if changed else text)
        refused = sum(isinstance(row, str) for seed in seeds for row in seed[name])
        count = sum(len(seed[name]) for seed in seeds)
        lines.append([name, *cells, f"{count}" + (f", {refused} refused" if refused else "")])
    return markdown_table(["known", *HEADINGS, "clips"], lines)
