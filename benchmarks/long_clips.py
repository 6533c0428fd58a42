"""Long walks in windows, against the truth and against all frames at once: python -m benchmarks long-clips."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from benchmarks.command_worker import run_command
from benchmarks.plots import plot_paths
from vggtjax.clips.clip import load_clip
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sources import open_source
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.pipeline.run import reconstruct
from vggtjax.pipeline.windows.frames import window_clips
from vggtjax.pipeline.windows.join import JoinRule
from vggtjax.pipeline.windows.plan import plan_windows
from vggtjax.pipeline.windows.run import tools_of
from vggtjax.pipeline.windows.store import WindowStore
from vggtjax.pipeline.windows.whole import Whole, store_window
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.similarity import centres, umeyama_sim3
from vggtjax.training.scenes import SceneConfig, SyntheticClip, closed_walk, load_textures, render, sample_scene

Kind = Literal["static", "dynamic"]
_STREAM = 0x77616C6B  # folded into the key, so that no other use of a seed draws these walks
_PACE = 6.0
_LEAST_MOVING, _MOST_MOVING = 0.08, 0.5  # share of the pixels of a dynamic walk
_TRIES = 20


class Row(NamedTuple):
    """Errors of a way on a walk; lengths are shares of the extent of the true path."""

    walk: str
    way: str
    to_truth: float
    to_full: float | None  # None for the path of all frames
    turned: float  # degrees, mean
    loops: str  # used of tried


def long_clips(
    *,
    out: Path,
    model: str = "demo",
    frames: int = 300,
    window: int = 16,
    overlaps: tuple[int, ...] = (4, 8),
    walks: int = 2,
    memory: tuple[int, ...] = (100, 300),
    seed: int = 0,
) -> None:
    """Measure the paths of long walks in windows, and the peak memory of long clips.

    Args:
        out: folder for the table and the plots.
        model: "demo", or weights as for vggtjax reconstruct.
        frames: of a walk, which comes back to where it began.
        window: frames of a window.
        overlaps: frames that neighbouring windows share.
        walks: static ones, and as many in which things move.
        memory: numbers of frames of the first walk of which memory and time are measured, all together and in
            windows, each in a process of its own; () for none.
        seed: another seed draws other walks.
    """
    if walks < 0 or frames <= window:
        raise InputError(f"walks is {walks} and frames {frames}; expected at least 0 walks, longer than a window")
    loaded, console = load_model(model), Console()
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for kind in get_args(Kind):
        before = len(rows)
        for number, walk in enumerate(drawn_walks(kind, walks, frames, loaded.config.image_size, seed)):
            if not rows:
                write_frames(np.asarray(walk.images), out / "frames")
            images, true = np.asarray(walk.images), np.asarray(walk.camera_from_world)
            rows += _measured(f"{kind} walk {number}", loaded, images, true, window, overlaps, out, console)
            _write(out / "paths.csv", rows)
        if walks:
            console.print(_table(f"{kind} walks, means", _means(rows[before:])))
    for count in memory:
        for length in (0, window):
            console.print(_peak(out / "frames", model, count, length, max(overlaps)), soft_wrap=True)


def drawn_walks(kind: Kind, count: int, frames: int, side: int, seed: int) -> Iterator[SyntheticClip]:
    """Yield walks around a small room as numpy; in dynamic ones things move over 8 to 50 % of the pixels."""
    config = SceneConfig(
        height=side, width=side, frames=frames, dynamic=float(kind == "dynamic"), static_camera=0.0, noise=0.01
    )
    textures = load_textures("test")

    @jax.jit
    def make(key, textures):
        scene_key, noise_key = jax.random.split(key)
        scene = closed_walk(sample_scene(scene_key, textures.tiles, config), pace=_PACE)
        return render(scene, noise_key, textures, config)

    found = 0
    for number in range(_TRIES):
        if found == count:
            return
        walk = jax.device_get(make(jax.random.fold_in(jax.random.key(seed), _STREAM + number), textures))
        if kind == "dynamic" and not _LEAST_MOVING <= walk.dynamic_mask.mean() <= _MOST_MOVING:
            continue
        yield walk
        found += 1


def _measured(
    name: str,
    model: Model,
    images: Float[np.ndarray, "S H W 3"],
    true: Float[np.ndarray, "S 3 4"],
    window: int,
    overlaps: tuple[int, ...],
    out: Path,
    console: Console,
) -> list[Row]:
    """Return the errors of every way on a walk, and draw the paths."""
    paths = dict(_paths(model, images, window, overlaps, console))
    full = next(iter(paths.values()))[0]
    rows = [_row(name, way, cameras, loops, full, true) for way, (cameras, loops) in paths.items()]
    shown = {way: cameras for way, (cameras, _) in paths.items()}
    plot_paths(out / f"{name.replace(' ', '-')}.png", shown, true, f"{name}, {len(full)} frames")
    console.print(_table(f"{name}, {len(full)} frames", rows))
    return rows


def _paths(
    model: Model, images: Float[np.ndarray, "S H W 3"], window: int, overlaps: tuple[int, ...], console: Console
) -> Iterator[tuple[str, tuple[Float[np.ndarray, "S 3 4"], str]]]:
    """Yield the name, the cameras and the loops of each way; windows of one overlap are run once for all ways."""
    config = model.config
    fitter = Fitter(size=config.image_size, patch=config.patch_size)
    began = time.perf_counter()
    clip = load_clip(images, size=fitter.size, patch=fitter.patch)
    full = reconstruct(model, clip).camera_from_world
    console.print(f"all frames together: {time.perf_counter() - began:.0f} s")
    yield "all frames together", (full, "")
    opened, tools = open_source(images), tools_of(model)
    for overlap in overlaps:
        began = time.perf_counter()
        cut = plan_windows(len(clip), window, overlap)
        with TemporaryDirectory() as folder:
            store, part = WindowStore(Path(folder), {}), clip
            for number, part in enumerate(window_clips(opened, Sampling(), fitter, cut)):
                store_window(number, part, cut[number], store, tools.run, tools.describe)
            console.print(f"{len(cut)} windows, overlap {overlap}: {time.perf_counter() - began:.0f} s")
            for masks in (False, True):
                for loops in (False, True):
                    whole = Whole(store, cut, tools.run, JoinRule(masks=masks))
                    result = whole.result(part, loops=loops)
                    used = f"{sum(tried.used for tried in whole.loops)} of {len(whole.loops)}" if loops else ""
                    name = f"overlap {overlap}, {'masks' if masks else 'no masks'}, {'loops' if loops else 'no loops'}"
                    yield name, (np.array(result.camera_from_world), used)
                    del result


def _row(name: str, way: str, cameras, loops: str, full, true) -> Row:
    scale = umeyama_sim3(centres(full), centres(true)).scale  # of the full path in the truth's unit
    extent = float(np.linalg.norm(np.ptp(centres(true), axis=0)))
    to_full = None if cameras is full else scale * centre_error(cameras, full) / extent
    return Row(name, way, centre_error(cameras, true) / extent, to_full, rotation_error(cameras, true), loops)


def _means(rows: list[Row]) -> list[Row]:
    """Return the mean of each way over walks."""
    means = []
    for way in dict.fromkeys(row.way for row in rows):
        here = [row for row in rows if row.way == way]
        to_full = [row.to_full for row in here if row.to_full is not None]
        to_truth, turned = (float(np.mean([getattr(row, name) for row in here])) for name in ("to_truth", "turned"))
        means.append(Row("", way, to_truth, float(np.mean(to_full)) if to_full else None, turned, ""))
    return means


def _table(title: str, rows: list[Row]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for heading in ("way", "ATE / extent", "to all frames", "rotation (deg)", "loops"):
        table.add_column(heading)
    for row in rows:
        to_full = "" if row.to_full is None else f"{row.to_full:.2%}"
        table.add_row(row.way, f"{row.to_truth:.2%}", to_full, f"{row.turned:.2f}", row.loops)
    return table


def _write(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)


def write_frames(images: Float[np.ndarray, "S H W 3"], folder: Path) -> None:
    """Write frames as pictures."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(folder / f"{number:04d}.png")


def _peak(folder: Path, model: str, frames: int, window: int, overlap: int) -> str:
    """Return the peak memory and the time of a long clip with its files, measured in a process of its own."""
    with TemporaryDirectory() as out:
        cut = ["--window", str(window), *(["--overlap", str(overlap)] if window else [])]
        words = ["reconstruct", str(folder), "--model", model, "--max-frames", str(frames), *cut]
        found = run_command([*words, "--out", f"{out}/result"], Path(out) / "cache")
    how, memory = f"in windows of {window}" if window else "together", (found["own"] / 1e6, found["total"] / 1e6)
    return (
        f"{frames} frames {how}: peak {memory[0]:.0f} MB of its own, {memory[1]:.0f} MB with mapped files, "
        f"{found['seconds']:.0f} s, {found['processor']:.0f} s of the processors"
    )
