"""A pool of world clips, rendered by processes beside a run and kept in a folder."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vggtjax.errors import ResultError, VggtjaxError
from vggtjax.storage.arrays import read_arrays
from vggtjax.storage.writing import write_errors, writing
from vggtjax.training.world.assets import chosen_files, fingerprint, read_assets
from vggtjax.training.world.casting import check_embree
from vggtjax.training.world.clip import GENERATOR, world_clip
from vggtjax.training.world.config import WorldConfig

_STREAM = 0x636C6970  # beside a seed, so that no other use of it draws these clips


class PoolClip(NamedTuple):
    """What training reads of clips. Metres; depth is 0 in the sky."""

    images: UInt8[np.ndarray, "*B S H W 3"]
    depth: Float[np.ndarray, "*B S H W"]  # float16
    moving: Bool[np.ndarray, "*B S H W"]
    tracks: Float[np.ndarray, "*B S P S 3"]
    camera_from_world: Float[np.ndarray, "*B S 3 4"]
    intrinsics: Float[np.ndarray, "*B S 3 3"]


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
    """Clips by job and number: a clip depends on these and on the files of its assets alone.

    A context manager: processes render clips that are not in the folder yet, and end with it.

    Raises InputError where a job's assets are not a folder of assets, OutputError where the folder cannot be written.
    """

    def __init__(self, folder: Path, jobs: Sequence[Job], workers: int = 1) -> None:
        check_embree()
        for assets in {job.assets for job in jobs}:
            chosen_files(Path(assets), "training")
        self._jobs, self._digests = list(jobs), [_digest(job) for job in jobs]
        names = [f"{job.height}x{job.width}_{digest}" for job, digest in zip(jobs, self._digests, strict=True)]
        self._folders = [folder / name for name in names]
        for path in self._folders:
            with write_errors(path):
                path.mkdir(parents=True, exist_ok=True)
        self._running: dict[tuple[int, int], Future] = {}
        spawned = multiprocessing.get_context("spawn")
        self._workers = ProcessPoolExecutor(workers, spawned, initializer=_begin)

    def __enter__(self) -> ClipPool:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._workers.shutdown(wait=True, cancel_futures=True)

    def ask(self, job: int, numbers: Sequence[int]) -> None:
        """Begin to render those clips that are missing."""
        for number in numbers:
            if (job, number) not in self._running and not self._path(job, number).exists():
                self._running[job, number] = self._workers.submit(_render, *self._task(job, number))

    def clips(self, job: int, numbers: Sequence[int], chosen: Sequence[np.ndarray]) -> PoolClip:
        """Return clips by their numbers, of each the frames `chosen`, in their order; waits for missing ones.

        Raises VggtjaxError where a process that renders has ended, and OutputError where it cannot write.
        """
        try:
            self.ask(job, numbers)
            for number in numbers:
                if (running := self._running.pop((job, number), None)) is not None:
                    running.result()
        except BrokenProcessPool:
            raise VggtjaxError(
                "a process that renders clips ended, perhaps for want of memory; the same command resumes the run"
            ) from None
        read = [self._read(job, number, frames) for number, frames in zip(numbers, chosen, strict=True)]
        return PoolClip(*(np.stack(column) for column in zip(*read, strict=True)))

    def _read(self, job: int, number: int, frames: np.ndarray) -> PoolClip:
        path = self._path(job, number)
        try:
            values = read_arrays(path, PoolClip._fields)
        except ResultError:  # cut off by a machine that ended, or removed
            values = {}
        if values.keys() != {*PoolClip._fields}:
            _render(*self._task(job, number), again=True)
            values = read_arrays(path, PoolClip._fields)
        values["tracks"] = values["tracks"][:, :, frames]
        return PoolClip(*(values[name][frames] for name in PoolClip._fields))

    def _task(self, job: int, number: int) -> tuple[Job, tuple[int, ...], Path]:
        seed = self._jobs[job].seed, _STREAM, int(self._digests[job][:8], 16), number
        return self._jobs[job], seed, self._path(job, number)

    def _path(self, job: int, number: int) -> Path:
        return self._folders[job] / f"{number:07d}.npz"


def _begin() -> None:
    """Make a worker leave Ctrl-C to the run, and end with it however the run ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def _render(job: Job, seed: tuple[int, ...], path: Path, *, again: bool = False) -> None:
    """Render a clip and write it, unless another run of the same pool has written it."""
    if path.exists() and not again:
        return
    size = {"frames": job.frames, "height": job.height, "width": job.width, "patch": job.patch}
    clip = world_clip(read_assets(job.assets), job.config, seed, **size)
    intrinsics = np.broadcast_to(clip.intrinsics, (job.frames, 3, 3))
    depth = clip.depth.astype(np.float16)
    kept = PoolClip(clip.images, depth, clip.dynamic_mask, clip.tracks, clip.camera_from_world, intrinsics)
    with writing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **kept._asdict())


def _digest(job: Job) -> str:
    """Return a name for the folder of a job's clips: another one for every other setting, and for other assets."""
    shape = job.frames, job.height, job.width, job.patch
    values = GENERATOR, fingerprint(job.assets), asdict(job.config), *shape, job.seed
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]
