"""Many clips in one call compared with one call per clip: python -m benchmarks batch.

Both sides run in this process with the model loaded. Cold runs start without compiled programs in memory or
on disk, and compile every shape of clip once; warm runs find all programs compiled. The sides alternate in order.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import load_clip
from vggtjax.clips.sources import clips_by_name
from vggtjax.errors import ClipError, InputError
from vggtjax.options import MethodName
from vggtjax.pipeline.batch import reconstruct_many
from vggtjax.pipeline.run import reconstruct
from vggtjax.pretrained.load import load_model
from vggtjax.results.archive import ARCHIVE_NAME, is_result
from vggtjax.scenes import SceneConfig, generate, load_textures
from vggtjax.storage.kept_memory import keep_freed_memory
from vggtjax.storage.writing import writing

_SHAPES = ((1.0, 1.0), (1.0, 0.75), (0.6, 1.0))  # width and height of the pictures, in the largest side
_ENLARGED = 2  # largest side of the pictures, in sides of the model
_draw = jax.jit(generate, static_argnums=2)

Side = Callable[[Model, dict[str, str], Path, MethodName], set[str]]


def batch(
    *,
    clips: int = 20,
    model: str = "demo",
    method: MethodName = "4dvggt-d",
    lengths: tuple[int, ...] = (4, 8),
    repeats: int = 2,
    seed: int = 0,
    out: Path | None = None,
) -> None:
    """Time reconstruct_many over clips of mixed size and length, one of them corrupt, and the sum of single runs.

    Args:
        clips: number of clips, with the corrupt one; at least two.
        model: "demo", or weights as for vggtjax reconstruct.
        method: which passes give depth and cameras.
        lengths: frames of the clips, in turn.
        repeats: runs of each side, cold and warm; the table shows their medians.
        seed: another seed draws other scenes.
        out: JSON file for the settings, every run's seconds and the ratios.
    """
    for name, value, least in (("clips", clips, 2), ("repeats", repeats, 1), ("lengths", min(lengths, default=0), 1)):
        if value < least:
            raise InputError(f"{name} is {value}; expected at least {least}")
    keep_freed_memory()  # as commands do
    jax.config.update("jax_enable_compilation_cache", False)  # no programs from disk
    console = Console()
    loaded = load_model(model)
    seconds: dict[str, dict[str, list[float]]] = {state: {side: [] for side in SIDES} for state in ("cold", "warm")}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with console.status("clips"):
            frames = write_clips(folder / "clips", clips, _ENLARGED * loaded.config.image_size, lengths, seed)
        sources = clips_by_name([str(folder / "clips")])
        _one_by_one(loaded, dict(list(sources.items())[:1]), folder / "before", method)  # late imports
        for state in seconds:
            for repeat in range(repeats):
                for side in list(SIDES)[:: 1 if repeat % 2 == 0 else -1]:
                    if state == "cold":
                        jax.clear_caches()
                    results = folder / f"{side} {state} {repeat}"
                    with console.status(f"{side}, {state}, run {repeat + 1} of {repeats}"):
                        began = time.perf_counter()
                        failed = SIDES[side](loaded, sources, results, method)
                        seconds[state][side].append(time.perf_counter() - began)
                    _check(results, sources, failed)
    medians = {
        state: {side: float(np.median(times)) for side, times in runs.items()} for state, runs in seconds.items()
    }
    ratios = {state: runs["one by one"] / runs["batch"] for state, runs in medians.items()}
    console.print(_table(medians, ratios, clips - 1, frames))
    if out is not None:
        settings = {
            "clips": clips,
            "frames": frames,
            "model": model,
            "method": method,
            "lengths": lengths,
            "seed": seed,
        }
        report = settings | {"seconds": seconds, "ratios": ratios}
        with writing(out) as temporary:
            temporary.write_text(json.dumps(report, indent=1) + "\n")


def write_clips(folder: Path, count: int, side: int, lengths: tuple[int, ...], seed: int) -> int:
    """Write generated clips, a folder of pictures each; the last picture of the middle clip is truncated.

    Args:
        folder: parent of the clips' folders.
        count: number of clips.
        side: largest side of the pictures, in pixels.
        lengths: frames of the clips, in turn; each length occurs with every shape of pictures.
        seed: of the scenes.

    Returns:
        The frames of the clips that are whole.
    """
    textures = load_textures("test")
    whole = 0
    for number in range(count):
        width, height = (round(share * side) for share in _SHAPES[number // len(lengths) % len(_SHAPES)])
        length = lengths[number % len(lengths)]
        config = SceneConfig(height=height, width=width, frames=max(lengths), dynamic=1.0)
        images = np.asarray(_draw(jax.random.fold_in(jax.random.key(seed), number), textures, config).images)
        clip = folder / f"clip{number:02d}"
        clip.mkdir(parents=True)
        for frame, image in enumerate(np.rint(255 * images[:length]).astype(np.uint8)):
            Image.fromarray(image).save(clip / f"{frame:03d}.png")
        if number == count // 2:
            last = clip / f"{length - 1:03d}.png"
            last.write_bytes(last.read_bytes()[:200])
        else:
            whole += length
    return whole


def _one_by_one(model: Model, sources: dict[str, str], out: Path, method: MethodName) -> set[str]:
    """Load, reconstruct and save clip after clip; return the names of those that fail."""
    failed = set()
    for name, source in sources.items():
        try:
            clip = load_clip(source, size=model.config.image_size, patch=model.config.patch_size)
        except ClipError:
            failed.add(name)
            continue
        reconstruct(model, clip, method=method).save(out / name)
    return failed


def _batch(model: Model, sources: dict[str, str], out: Path, method: MethodName) -> set[str]:
    """Load, reconstruct and save all clips in one call; return the names of those that fail."""
    outcomes = reconstruct_many(model, sources, out, options={"method": method})
    return {outcome.name for outcome in outcomes if outcome.status == "failed"}


SIDES: dict[str, Side] = {"one by one": _one_by_one, "batch": _batch}


def _check(results: Path, sources: dict[str, str], failed: set[str]) -> None:
    """Raise InputError unless one clip has failed and every other one has a result."""
    there = {name for name in sources if is_result(results / name / ARCHIVE_NAME)}
    if len(failed) != 1 or there != set(sources) - failed:
        raise InputError(f"{len(failed)} clips failed and {len(there)} of {len(sources)} have results; expected 1 less")


def _table(medians: dict[str, dict[str, float]], ratios: dict[str, float], clips: int, frames: int) -> Table:
    table = Table(title=f"{clips} clips of {frames} frames, and a corrupt one", title_justify="left", box=None)
    for heading in ("programs", "clips", "seconds", "clips/s", "frames/s", "throughput"):
        table.add_column(heading, justify="left" if heading in ("programs", "clips") else "right")
    for state, sides in medians.items():
        for side, seconds in sides.items():
            ratio = f"{ratios[state]:.3f}" if side == "batch" else "1"
            table.add_row(state, side, f"{seconds:.2f}", f"{clips / seconds:.2f}", f"{frames / seconds:.1f}", ratio)
    return table
