"""A pool of world clips that grows with the steps of a run: rendered by processes beside it, kept in a folder."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np

from vggtjax.errors import ResultError
from vggtjax.storage.arrays import read_arrays
from vggtjax.storage.writing import writing
from vggtjax.training.world.assets import read_assets
from vggtjax.training.world.clip import WorldClip, world_clip
from vggtjax.training.world.config import WorldConfig

_GENERATOR = 3  # raised with every change that gives a seed another clip


class PoolClip(NamedTuple):
    """What training reads of clips, stacked: [B, S, ...]."""

    images: np.ndarray  # bytes
    depth: np.ndarray  # float16, metres, 0 in the sky
    moving: np.ndarray
    tracks: np.ndarray  # [B, S, P, S, 3]
    camera_from_world: np.ndarray
    intrinsics: np.ndarray  # [B, S, 3, 3]


class Job(NamedTuple):
    """What decides a clip of a pool, but for its number."""

    assets: str
    config: WorldConfig
    frames: int
    height: int
    width: int
    patch: int
    seed: int


class ClipPool:
    """Clips of one `Job` each size, by number: a clip depends on its job and its number alone.

    A context manager: processes render clips that are not in the folder yet, and end with it.
    """

    def __init__(self, folder: Path, jobs: Sequence[Job], workers: int = 1) -> None:
        for job in jobs:
            read_assets(job.assets)  # now, so that a folder that is not one is said at once
        self._folders = [folder / _digest(job) for job in jobs]
        for path in self._folders:
            path.mkdir(parents=True, exist_ok=True)
        self._jobs, self._running = list(jobs), {}
        self._workers = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))

    def __enter__(self) -> ClipPool:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._workers.shutdown(wait=False, cancel_futures=True)

    def ask(self, job: int, numbers: Sequence[int]) -> None:
        """Begin to render those clips that are missing."""
        for number in numbers:
            if (job, number) not in self._running and not self._path(job, number).exists():
                work = self._workers.submit(_render, self._jobs[job], number, self._path(job, number))
                self._running[job, number] = work

    def clips(self, job: int, numbers: Sequence[int], chosen: Sequence[np.ndarray]) -> PoolClip:
        """Return clips by their numbers, of each the frames `chosen`, in their order; waits for missing ones."""
        self.ask(job, numbers)
        read = []
        for number, frames in zip(numbers, chosen, strict=True):
            running: Future | None = self._running.pop((job, number), None)
            if running is not None:
                running.result()
            read.append(self._read(job, number, frames))
        return PoolClip(*(np.stack(column) for column in zip(*read, strict=True)))

    def _read(self, job: int, number: int, frames: np.ndarray) -> PoolClip:
        path = self._path(job, number)
        try:
            values = read_arrays(path)
        except ResultError:  # cut off by a full disk or an ended machine
            path.unlink()
            _render(self._jobs[job], number, path)
            values = read_arrays(path)
        values["tracks"] = values["tracks"][:, :, frames]
        clip = PoolClip(*(values[name] for name in PoolClip._fields))
        return PoolClip(*(value[frames] for value in clip))

    def _path(self, job: int, number: int) -> Path:
        return self._folders[job] / f"{number:07d}.npz"


def _render(job: Job, number: int, path: Path) -> None:
    """Render a clip and write it."""
    size = {"frames": job.frames, "height": job.height, "width": job.width, "patch": job.patch}
    clip: WorldClip = world_clip(read_assets(job.assets), job.config, (job.seed, number), **size)
    intrinsics = np.broadcast_to(clip.intrinsics, (job.frames, 3, 3))
    depth = clip.depth.astype(np.float16)
    kept = PoolClip(clip.images, depth, clip.dynamic_mask, clip.tracks, clip.camera_from_world, intrinsics)
    with writing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **kept._asdict())


def _digest(job: Job) -> str:
    """Return a name for the folder of a job's clips: another one for every other setting."""
    values = (
        _GENERATOR,
        asdict(job.config),
        job.frames,
        job.height,
        job.width,
        job.patch,
        job.seed,
        Path(job.assets).name,
    )
    text = json.dumps(values, sort_keys=True)
    return f"{job.height}x{job.width}_{hashlib.sha256(text.encode()).hexdigest()[:12]}"
