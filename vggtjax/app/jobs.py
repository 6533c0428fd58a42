"""The jobs of the app: one at a time, in the order they came; stages to watch; cancel; results in one bounded folder.

Knows nothing of browsers. Does not import jax before the first job.
"""

from __future__ import annotations

import logging
import re
import secrets
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vggtjax.app.limits import Limits
from vggtjax.app.models import Models
from vggtjax.app.uploads import check_clip, clip_of, safe_stem
from vggtjax.errors import InputError, VggtjaxError, check_choice, whole_number
from vggtjax.options import Options
from vggtjax.progress import Progress

if TYPE_CHECKING:
    from vggtjax.app.outputs import Outputs
    from vggtjax.checkpoint import Model
    from vggtjax.clips.clip import Clip

State = Literal["waiting", "running", "done", "failed", "cancelled"]
_MOST_FPS = 60

logger = logging.getLogger(__name__)


class CancelledError(Exception):
    """Raised inside a cancelled job, at its next stage or step."""


@dataclass(frozen=True)
class Request:
    """What a user asks for; without files, the embedded clip."""

    files: tuple[Path, ...]
    model: str
    method: str = "4dvggt-d"
    frames: int = 16
    fps: float | None = None  # None: spread over the whole video


@dataclass
class Stage:
    """A stage of a job, as it is shown: seconds once it is over, steps where it counts some."""

    name: str
    started: float = field(default_factory=time.monotonic)
    seconds: float | None = None
    done: int = 0
    total: int | None = None


class Job:
    """One reconstruction, from request to outputs."""

    def __init__(self, request: Request, source: Path | tuple[Path, ...] | None, owner: str, folder: Path) -> None:
        """`source` is the clip in the uploads; None is the embedded one."""
        self.request, self.source, self.owner, self.folder = request, source, owner, folder
        self.state: State = "waiting"
        self.message = ""  # why it failed, in one sentence
        self.stages: list[Stage] = []
        self.outputs: Outputs | None = None
        self._cancelled = threading.Event()

    @property
    def is_over(self) -> bool:
        return self.state in ("done", "failed", "cancelled")

    @property
    def is_cancelled(self) -> bool:
        """Whether it was cancelled; it may still run to the end of its stage."""
        return self._cancelled.is_set()

    @contextmanager
    def on_stage(self, name: str) -> Iterator[Progress]:
        """Show a stage while the body runs: an `OnStage`."""
        self._check()
        stage = Stage(name)
        self.stages.append(stage)

        def advance(done: int, total: int | None) -> None:
            stage.done, stage.total = done, total
            self._check()

        yield advance
        stage.seconds = time.monotonic() - stage.started

    def cancel(self) -> None:
        self._cancelled.set()

    def _check(self) -> None:
        if self.is_cancelled:
            raise CancelledError


class Desk:
    """Takes jobs, runs one at a time, and keeps the last results in `folder`."""

    def __init__(
        self, folder: Path, models: Models, limits: Limits, run: Callable[[Job, Models, Limits], None] | None = None
    ) -> None:
        """`run` does the work of a job; by default it reconstructs."""
        self.models, self.limits = models, limits
        self.uploads, self.results = folder / "uploads", folder / "results"
        for path in (self.uploads, self.results):
            path.mkdir(parents=True)
        self._run = run or run_job
        self._lock = threading.Lock()
        self._open: list[Job] = []  # running first, then waiting in their order
        self._finished: deque[Job] = deque()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="job")

    def submit(self, request: Request, owner: str) -> Job:
        """Check a request and queue it.

        Raises InputError for a value that the page does not offer, files that are no clip, a full queue, or an owner
        who has an open job.
        """
        check_choice("model", request.model, self.models.names)
        Options(method=request.method)  # pyright: ignore[reportArgumentType]
        if whole_number("frames", request.frames, 1) > self.limits.max_frames:
            raise InputError(f"frames is {request.frames}; expected at most {self.limits.max_frames}")
        if request.fps is not None and not 0 < request.fps <= _MOST_FPS:
            raise InputError(f"fps is {request.fps}; expected a number above 0, at most {_MOST_FPS}")
        source = clip_of(request.files, self.uploads, self.limits) if request.files else None
        job = Job(request, source, owner, self.results / secrets.token_urlsafe(16))
        with self._lock:
            if any(other.owner == owner for other in self._open):
                raise InputError("your earlier job is not over yet; wait for it or cancel it")
            if len(self._open) > self.limits.max_waiting:
                raise InputError(f"the queue is full, with {len(self._open) - 1} waiting; try again in a few minutes")
            self._open.append(job)
            self._worker.submit(self._work, job)
        return job

    def ahead(self, job: Job) -> int:
        """Return how many jobs come before this one."""
        with self._lock:
            return self._open.index(job) if job in self._open else 0

    def cancel(self, owner: str) -> None:
        """Cancel the open job of an owner: at once where it waits, else at its next stage or step."""
        with self._lock:
            for job in [job for job in self._open if job.owner == owner]:
                job.cancel()
                if job.state == "waiting":
                    job.state = "cancelled"
                    self._open.remove(job)

    def close(self) -> None:
        """Cancel all jobs, and wait for the running one to stop."""
        with self._lock:
            for job in self._open:
                job.cancel()
        self._worker.shutdown(cancel_futures=True)

    def _work(self, job: Job) -> None:
        with self._lock:
            if job.is_over:  # cancelled while it waited
                return
            job.state = "running"
        state: State = "failed"
        try:
            self._run(job, self.models, self.limits)
            state = "cancelled" if job.is_cancelled else "done"
        except CancelledError:
            state = "cancelled"
        except Exception as error:
            job.message = _sentence(error, (job.folder, self.uploads))
        with self._lock:
            self._open.remove(job)
            if state == "done":
                self._finished.append(job)
            old = [self._finished.popleft() for _ in range(len(self._finished) - self.limits.max_results)]
        for each in old if state == "done" else (job,):
            shutil.rmtree(each.folder, ignore_errors=True)
        job.state = state


def run_job(job: Job, models: Models, limits: Limits) -> None:
    """Reconstruct a job's clip and write what is shown of it; `job.on_stage` raises CancelledError."""
    request = job.request
    with job.on_stage("check the clip"):
        checked = None if job.source is None else check_clip(job.source, request.frames, request.fps, limits)
    with job.on_stage("load model") as progress:
        model = models.get(request.model, progress)
    with job.on_stage("load clip") as progress:
        from vggtjax.clips.clip import read_clip
        from vggtjax.clips.preprocessing import Framing

        if checked is None:
            clip = _demo_clip(model, request.frames)
        else:
            clip = read_clip(*checked, Framing().fitter(model.config), progress)
    from vggtjax.app.outputs import write_outputs
    from vggtjax.pipeline.run import reconstruct

    # Padded: clips of similar length share compiled programs.
    result = reconstruct(
        model,
        clip,
        size=clip.size,
        pad_frames=True,
        on_stage=job.on_stage,
        method=request.method,
        consistent_depth=True,
    )
    name = f"{safe_stem(request.files[0].name) if request.files else 'demo-clip'}-{request.method}"
    job.outputs = write_outputs(result, job.folder, name, job.on_stage)


def _demo_clip(model: Model, frames: int) -> Clip:
    """Return the first frames of the embedded clip, at its own size for the embedded model."""
    from vggtjax.clips.clip import load_clip
    from vggtjax.pretrained.embedded import NOTE, demo_clip

    images = demo_clip().images[:frames]
    return load_clip(images, model=model, size=images.shape[2] if model.note == NOTE else None)


def _sentence(error: Exception, folders: tuple[Path, ...]) -> str:
    """Return the sentence that a user reads: of our own errors, without the folders of this machine."""
    if isinstance(error, VggtjaxError):
        places = "|".join(re.escape(str(folder.resolve())) for folder in folders)
        return re.sub(rf"(?:{places})/(?:[0-9a-f]{{64}}/)?", "", str(error))
    if isinstance(error, MemoryError):
        return "this machine has too little memory for the job; choose fewer frames"
    logger.error("a job failed", exc_info=error)
    if isinstance(error, OSError):
        return "the results cannot be written; the person who runs this app finds the reason in its log"
    return "the program failed; the person who runs this app finds the reason in its log"
