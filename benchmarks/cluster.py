"""What a batch on a cluster takes beside its clips: python -m benchmarks cluster.

The list of clips is read, workers of Ray are started that do nothing, clips are handed to them, and results are looked
for that an earlier run has left: one process's work, so its speed bounds the number of workers. A result of
VGGT's size is written, which every worker does, as often as it computes.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from vggtjax.clips.manifest import read_manifest
from vggtjax.errors import whole_number
from vggtjax.pipeline.cluster_driver import Dispatcher, Plan, connect
from vggtjax.pipeline.cluster_worker import Job, Place, Started
from vggtjax.pipeline.destination import LocalFolder
from vggtjax.pipeline.recipe import ClipOutcome, Recipe
from vggtjax.pretrained.embedded import demo_clip
from vggtjax.results.archive import ARCHIVE_NAME
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.saving import Group, Saving
from vggtjax.storage.versions import running_versions


class Idle:
    """A worker that does nothing."""

    def place(self) -> Place:
        """Return where the worker runs."""
        return Place("here", os.getpid(), running_versions())

    def start(self, job: Job) -> Started:
        """Load no model."""
        return Started({}, "")

    def run(self, name: str, source: str) -> ClipOutcome:
        """Say that a clip is done."""
        return ClipOutcome(name, "done")

    def close(self) -> None:
        """Do nothing."""


def cluster(
    *, rows: int = 100_000, clips: int = 2000, results: int = 1000, workers: int = 2, frames: int = 24, side: int = 518
) -> None:
    """Time what one process does for a batch on a cluster.

    Args:
        rows: of the list of clips
        clips: that are handed to workers
        results: that are looked for
        workers: that do nothing
        frames: of a result that is written
        side: of its pictures
    """
    for name, value in (("rows", rows), ("clips", clips), ("results", results), ("workers", workers)):
        whole_number(name, value, 1)
    with tempfile.TemporaryDirectory() as folder:
        seconds = {
            "read rows of a list": (rows, _read(Path(folder), rows)),
            "look for results": (results, _looked_for(Path(folder), results)),
            "hand clips to workers": (clips, _handed(Path(folder), clips, workers)),
        }
    table = Table(box=None, pad_edge=False)
    for column in ("work", "count", "seconds", "per second"):
        table.add_column(column, justify="left" if column == "work" else "right")
    for name, (count, taken) in seconds.items():
        table.add_row(name, f"{count}", f"{taken:.2f}", f"{count / taken:,.0f}")
    Console().print(table)
    result = _result(frames, side)
    groups: tuple[tuple[Group, ...] | None, ...] = (None, ("depth", "cameras", "masks"), ())
    for only in groups:
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            result.save(Path(folder) / "result", saving=Saving(only=only))
            taken = time.perf_counter() - started
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        files = "all files" if only is None else ", ".join(("the archive", *only))
        Console().print(f"{frames} frames of {side} x {side}: {files} written in {taken:.2f} s, {size / 1e6:.1f} MB")


def _result(frames: int, side: int) -> Reconstruction:
    """Return a result of the embedded clip's pictures, enlarged, with a wall that is not quite even."""
    pictures = demo_clip().images
    big = [Image.fromarray((255 * picture).astype(np.uint8)).resize((side, side)) for picture in pictures]
    random = np.random.default_rng(0)
    shape = (frames, side, side)
    moving = np.zeros(shape, bool)
    moving[:, side // 3 : side // 2, side // 3 : side // 2] = True
    return Reconstruction(
        depth=(3 + 0.01 * random.random(shape)).astype(np.float32),
        depth_confidence=(1 + random.random(shape)).astype(np.float32),
        saliency=np.zeros((frames, side // 14, side // 14), np.float32),
        dynamic_mask=moving,
        camera_from_world=np.tile(np.eye(3, 4, dtype=np.float32), (frames, 1, 1)),
        intrinsics=np.tile(np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1]], np.float32), (frames, 1, 1)),
        images=np.stack([np.asarray(big[frame % len(big)]) for frame in range(frames)]),
        frame_names=tuple(f"{frame:06}" for frame in range(frames)),
        timestamps=None,
        method="4dvggt-d",
        model_name="none",
        settings={},
        source_size=np.full((frames, 2), side),
        source_scale=np.ones((frames, 2)),
        source_offset=np.zeros((frames, 2)),
        valid_box=np.tile([0, 0, side, side], (frames, 1)),
    )


def _read(folder: Path, rows: int) -> float:
    path = folder / "clips.csv"
    lines = (f"s3://bucket/videos/{number:07}.mp4,{number:07}" for number in range(rows))
    path.write_text("\n".join(["source,name", *lines]))
    started = time.perf_counter()
    read_manifest(path)
    return time.perf_counter() - started


def _looked_for(folder: Path, results: int) -> float:
    for number in range(results):
        (folder / f"results/{number}").mkdir(parents=True)
        arrays = {"format_version": 1, "depth": np.zeros((2, 8, 8)), "camera_from_world": np.zeros((2, 3, 4))}
        np.savez(folder / f"results/{number}" / ARCHIVE_NAME, **arrays)
    started = time.perf_counter()
    found = LocalFolder(folder / "results").finished(map(str, range(results)))
    assert len(found) == results
    return time.perf_counter() - started


def _handed(folder: Path, clips: int, workers: int) -> float:
    import ray

    sent: list[float] = []
    connect("local")
    try:
        job = Job(_nothing, Recipe(), LocalFolder(folder / "out"), str(folder))
        plan = Plan(job, {str(number): "" for number in range(clips)}, workers=workers)
        Dispatcher(plan, lambda message: sent.append(time.perf_counter()), Idle).run()
    finally:
        ray.shutdown()
    return sent[-1] - sent[0]  # from the first worker that is ready to the last clip


def _nothing():
    raise NotImplementedError
