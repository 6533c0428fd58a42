"""A worker of a cluster: one model, and clips by name. Does not import jax before it starts."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

from vggtjax.batch.cluster_options import Cluster
from vggtjax.batch.destination import Destination, has_changed
from vggtjax.batch.recipe import BatchRecipe, ClipOutcome, failed
from vggtjax.clips.fetched import Fetched
from vggtjax.errors import OutputError, VggtjaxError, one_line
from vggtjax.progress import StageSeconds
from vggtjax.storage.versions import running_versions

if TYPE_CHECKING:
    from vggtjax.batch.clip_work import ClipWork
    from vggtjax.checkpoint import Model
    from vggtjax.method.fusion_family import FusionParams

AT_ONCE = 3  # clips in the work of a worker: one is loaded, one computed, one written
Load = Callable[[], "tuple[Model, FusionParams | None]"]


@dataclass(frozen=True)
class Job:
    """What a worker is told once."""

    load: Load  # returns the model and the fitted rule of fusion
    recipe: BatchRecipe
    out: Destination
    folder: str  # where relative paths start
    cluster: Cluster


class Place(NamedTuple):
    """Where a worker runs, and which code."""

    host: str
    process: int
    versions: str

    def __str__(self) -> str:
        return f"{self.host}, process {self.process}"


class Started(NamedTuple):
    """A worker that is ready, with the settings that it would write, and what is to be said of its model."""

    settings: dict[str, Any]
    warning: str


class Worker:
    """Runs in a process of its own. Several threads call `run`: while one computes, others load and write."""

    def __init__(self) -> None:
        self._loading, self._computing, self._writing = Lock(), Lock(), Lock()
        self._fetched = Fetched()
        self._work: ClipWork | None = None
        self._out: Destination | None = None
        self._warning = ""

    def place(self) -> Place:
        """Return where the worker runs."""
        return Place(socket.gethostname(), os.getpid(), running_versions())

    def start(self, job: Job, threads: int | None = None) -> Started:
        """Load the model, unless it is there. `threads` is for computing on a CPU; None for all."""
        with suppress(OSError):  # a machine without the folder: relative paths are not found
            os.chdir(job.folder)
        if threads is not None:
            os.environ.setdefault("NPROC", str(threads))  # XLA asks for it when jax begins
        from vggtjax.batch.clip_work import ClipWork

        if self._work is None:
            model, fusion = job.load()
            self._out, self._work = job.out, ClipWork(model, fusion, job.recipe, job.out)
            self._warning = model.warning
        return Started(self._work.settings, self._warning)

    def run(self, name: str, source: str) -> ClipOutcome:
        """Do a clip, unless its result is there."""
        if self._work is None or self._out is None:
            raise RuntimeError("start first")
        from vggtjax.batch.clip_work import LongClip

        try:
            if self._out.has(name) and not has_changed(self._out, name, source):
                return ClipOutcome(name, "kept")
            with self._loading:
                local = self._fetched.local(name, source)
                clip = self._work.long_clip(local, clips=AT_ONCE) or self._work.load(local)
            with self._computing:
                seconds = StageSeconds()
                result = clip if isinstance(clip, LongClip) else self._work.reconstruct_or_cut(name, clip, seconds)
                if isinstance(clip, LongClip) or isinstance(result, LongClip):
                    del clip  # its frames are read again, window by window
                    return self._work.run_long(name, local, result)  # pyright: ignore[reportArgumentType]
            with self._writing:
                return self._work.write(name, clip, result, seconds.seconds)
        except OutputError as error:  # a worker that was thought lost may have written the same result by now
            return ClipOutcome(name, "kept") if self._out.has(name) else failed(name, error)
        except (VggtjaxError, MemoryError) as error:
            return failed(name, error)
        except Exception as error:  # a fault of this program costs one clip, not the batch
            return failed(name, RuntimeError(f"{type(error).__name__}: {one_line(str(error))}"))
        finally:
            self._fetched.drop(name)

    def close(self) -> None:
        """Remove what the worker keeps on the disk."""
        self._fetched.__exit__()
