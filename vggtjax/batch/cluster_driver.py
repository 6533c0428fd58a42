"""The process that drives Ray: workers are started, given clips, and replaced. Imports Ray when it runs."""

from __future__ import annotations

import logging
import multiprocessing
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from vggtjax.batch.cluster_worker import AT_ONCE, Job, Place, Refused, Started, Worker
from vggtjax.batch.recipe import ClipOutcome, failed
from vggtjax.errors import ClusterError, VggtjaxError, one_line
from vggtjax.storage.versions import running_versions

_TICK = 1.0  # seconds between looks at what Ray does not tell
_HEALTH = 10.0  # seconds between looks at this machine's part of the cluster
_PATIENCE = 60.0  # seconds without a worker before a word about it
_MOST_LOST_STARTS = 3  # workers in a row that end before they are ready
_STORE_BYTES = 2**27  # of a new cluster's shared memory: clips do not pass through it
_GOODBYE = 10  # seconds for workers to tidy up


class Note(NamedTuple):
    """A line for the user."""

    text: str


class Failure(NamedTuple):
    """What ends the batch."""

    error: VggtjaxError


@dataclass(frozen=True)
class Plan:
    """What is to be done where; None for what the cluster decides."""

    job: Job
    sources: Mapping[str, str]
    address: str | None = None
    workers: int | None = None
    cpus: int | None = None
    gpus: float | None = None


class Share(NamedTuple):
    """How many workers there are, and what each takes."""

    workers: int
    cpus: int
    gpus: float


def drive(pipe: Connection, log: str, plan: Plan) -> None:
    """Run a plan; send notes and outcomes, then None, or a failure. Everything that Ray prints goes into a file."""
    with Path(log).open("wb", buffering=0) as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    import ray

    try:
        connect(plan.address)
        Dispatcher(plan, pipe.send).run()
        pipe.send(None)
    except VggtjaxError as error:
        pipe.send(Failure(error))
    except (BrokenPipeError, KeyboardInterrupt):  # nobody listens any more
        pass
    finally:
        ray.shutdown()


def shared(nodes: Sequence[Mapping[str, float]], plan: Plan) -> Share:
    """Return the share of each worker of a cluster whose machines have so many "CPU" and "GPU".

    Raises ClusterError where no machine has room for a worker, unless their number is given: a cluster may grow.
    """
    gpus = plan.gpus
    if gpus is None:
        gpus = float(plan.job.recipe.devices) if any(node.get("GPU", 0) for node in nodes) else 0.0
    counts = sorted(int(node.get("CPU", 0)) for node in nodes if node.get("CPU", 0) >= 1) or [0]
    if plan.cpus is not None:
        cpus = plan.cpus
    elif gpus:
        cpus = 1
    elif plan.workers is None:
        cpus = max(1, counts[0])  # a worker on every machine
    else:
        cpus = max(1, min(counts[-1], sum(counts) // plan.workers))
    room = sum(
        min(int(node.get("CPU", 0) // cpus), int(node.get("GPU", 0) // gpus) if gpus else int(node.get("CPU", 0)))
        for node in nodes
    )
    if plan.workers is None and not room:
        has = " and ".join(f"{node.get('CPU', 0):g} CPUs, {node.get('GPU', 0):g} GPUs" for node in nodes[:4])
        needs = f"{cpus} CPU{'s' if cpus > 1 else ''}{f' and {gpus:g} GPUs' if gpus else ''}"
        raise ClusterError(
            f"no machine of the cluster has room for a worker, which takes {needs} ({has or 'no machine'}); "
            "give --worker-cpus and --worker-gpus that fit, or --workers for a cluster that grows"
        )
    return Share(plan.workers or room, cpus, gpus)


def connect(address: str | None) -> None:
    """Join the cluster at an address, or start one of this machine. Raises ClusterError where there is none."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    address = address or os.environ.get("RAY_ADDRESS") or "local"
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address == "local":
        options |= {"include_dashboard": False, "object_store_memory": _STORE_BYTES}
    try:
        ray.init(address=address, **options)
    except Exception as problem:  # ConnectionError, RuntimeError, ValueError, ...: Ray has no common one
        reason = one_line(str(problem), 200) or type(problem).__name__
        raise ClusterError(
            f"no cluster at {address} can be joined ({reason}); start one with: ray start --head"
        ) from problem


@dataclass(eq=False)
class _Slot:
    """A worker, and the clips in its work."""

    actor: Any
    place: Place | None = None
    ready: bool = False
    clips: list[str] = field(default_factory=list)
    is_alone: bool = False  # its clip has lost a worker before

    def __str__(self) -> str:
        return "a worker" if self.place is None else f"a worker ({self.place})"


class Dispatcher:
    """Gives clips to workers until every clip has an outcome."""

    def __init__(self, plan: Plan, send: Callable[[Any], None], worker: type = Worker) -> None:
        self._plan, self._send, self._worker = plan, send, worker
        self._waiting, self._again = deque(plan.sources), deque[str]()
        self._losses = Counter[str]()  # workers that ended with a clip in their work
        self._slots: list[_Slot] = []
        self._tasks: dict[Any, tuple[_Slot, str | None]] = {}  # by Ray's reference; None: the worker's own start
        self._settings: tuple[Place, dict[str, Any]] | None = None
        self._lost_starts = 0
        self._versions = running_versions()
        self._wanted, self._job = 0, plan.job  # the cluster says more, in `run`
        self._class: Any = None

    def run(self) -> None:
        """Do all clips. Raises ClusterError and what beginning the batch raises."""
        import ray

        share = shared([node["Resources"] for node in ray.nodes() if node["Alive"]], self._plan)
        self._wanted = share.workers
        # Rounding goes by the number of threads, so only a number that the user gives limits them.
        self._job = replace(self._plan.job, threads=None if share.gpus else self._plan.cpus)
        self._class = ray.remote(self._worker).options(
            num_cpus=share.cpus, num_gpus=share.gpus, max_restarts=0, max_task_retries=0, max_concurrency=AT_ONCE + 1
        )
        checked = said = time.monotonic()
        while self._waiting or self._again or any(slot.clips for slot in self._slots):
            self._grow()
            self._assign()
            references = list(self._tasks)
            done, _ = ray.wait(references, timeout=_TICK)
            if done:
                done, _ = ray.wait(references, num_returns=len(references), timeout=0)
            for reference in done:
                if reference in self._tasks:  # a worker that is lost takes its other tasks along
                    self._finish(reference)
            now = time.monotonic()
            if now - checked > _HEALTH:
                checked = now
                _check_alive()
            if any(slot.ready for slot in self._slots):
                said = now
            elif now - said > _PATIENCE:
                said = now
                needs = f"{share.cpus} CPUs and {share.gpus:g} GPUs each"
                self._send(Note(f"no worker has begun; the cluster is asked for {self._wanted} of {needs}"))
        ray.wait([slot.actor.close.remote() for slot in self._slots], num_returns=len(self._slots), timeout=_GOODBYE)

    def _grow(self) -> None:
        """Ask for workers, as many as there are clips, and let go of those without work."""
        left = len(self._waiting) + len(self._again)
        if not left:
            for slot in [slot for slot in self._slots if slot.ready and not slot.clips]:
                slot.actor.close.remote()
                self._slots.remove(slot)  # Ray ends a worker that nobody names any more
        busy = sum(bool(slot.clips) for slot in self._slots)
        while len(self._slots) < min(self._wanted, left + busy):
            slot = _Slot(self._class.remote())
            self._slots.append(slot)
            self._tasks[slot.actor.place.remote()] = (slot, None)

    def _assign(self) -> None:
        """Give clips to workers that have room, first to those with the least work."""
        ready = [slot for slot in self._slots if slot.ready and not slot.is_alone]
        deepest = AT_ONCE if len(self._waiting) >= len(ready) else 1
        for depth in range(deepest):
            for slot in [slot for slot in ready if len(slot.clips) == depth and not slot.is_alone]:
                if depth == 0 and self._again:
                    slot.is_alone = True
                    self._give(slot, self._again.popleft())
                elif self._waiting:
                    self._give(slot, self._waiting.popleft())

    def _give(self, slot: _Slot, name: str) -> None:
        slot.clips.append(name)
        self._tasks[slot.actor.run.remote(name, self._plan.sources[name])] = (slot, name)

    def _finish(self, reference: Any) -> None:
        """Take the answer of a worker."""
        import ray
        from ray.exceptions import RayError, RayTaskError

        slot, name = self._tasks.pop(reference)
        try:
            answer: Any = ray.get(reference)
        except RayTaskError as problem:  # the worker has no such class, or this program has a fault
            raise ClusterError(f"{slot} cannot begin: {_short(problem)}") from problem
        except RayError as problem:
            self._lose(slot, name, problem)
            return
        if name is not None:
            slot.clips.remove(name)
            slot.is_alone = False
            self._send(_told(answer, again=name in self._losses))
        elif isinstance(answer, Place):
            slot.place = answer
            if answer.versions != self._versions:
                raise ClusterError(
                    f"{slot} runs {answer.versions}, this command {self._versions}; install the same on all machines"
                )
            self._tasks[slot.actor.start.remote(self._job)] = (slot, None)
        else:
            self._begin(slot, answer)

    def _begin(self, slot: _Slot, answer: Started | Refused) -> None:
        """Give work to a worker from now on. Raises ClusterError where it would compute something else."""
        assert slot.place is not None
        if isinstance(answer, Refused):
            raise ClusterError(f"{slot} cannot begin: {answer.reason}")
        if self._settings is None:
            self._plan.job.out.begin(answer.settings)
            self._settings = slot.place, answer.settings
            if answer.warning:
                self._send(Note(answer.warning))
        first, settings = self._settings
        if settings != answer.settings:
            names = [key for key in settings | answer.settings if settings.get(key) != answer.settings.get(key)]
            raise ClusterError(
                f"{slot} has another {', '.join(names)} than the one on {first}; give all the same files"
            )
        slot.ready, self._lost_starts = True, 0
        count = sum(slot.ready for slot in self._slots)
        self._send(Note(f"worker {count} of {self._wanted} is ready: {slot.place}"))

    def _lose(self, slot: _Slot, name: str | None, problem: Exception) -> None:
        """Replace a worker that has ended; its clips are run again, or fail if they are run again already."""
        import ray

        self._slots.remove(slot)
        self._tasks = {reference: task for reference, task in self._tasks.items() if task[0] is not slot}
        ray.kill(slot.actor)  # it may be alive where this machine cannot reach it
        if not slot.ready:
            self._lost_starts += 1
            if self._lost_starts >= _MOST_LOST_STARTS and not any(slot.ready for slot in self._slots):
                raise ClusterError(f"{self._lost_starts} workers in a row ended before they began: {_short(problem)}")
            if self._lost_starts >= _MOST_LOST_STARTS:
                self._wanted, self._lost_starts = max(1, self._wanted - 1), 0
        self._send(Note(f"{slot} has ended; in its work: {', '.join(map(one_line, slot.clips)) or 'nothing'}"))
        for clip in slot.clips:
            self._losses[clip] += 1
            if slot.is_alone:
                self._send(failed(clip, ClusterError(f"two workers ended with it in their work: {_short(problem)}")))
            else:
                self._again.append(clip)


def _told(outcome: ClipOutcome, *, again: bool) -> ClipOutcome:
    """Return the outcome of a clip; one that was lost and is there had been finished in this run."""
    return outcome._replace(status="done") if again and outcome.status == "kept" else outcome


def _check_alive() -> None:
    """Raise ClusterError where this machine is no part of the cluster any more; end where nobody listens."""
    import ray

    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():
        raise BrokenPipeError
    own = ray.get_runtime_context().get_node_id()
    if not any(node["NodeID"] == own and node["Alive"] for node in ray.nodes()):
        raise ClusterError("this machine has left the cluster; finished clips are kept: run the command again")


def _short(problem: Exception) -> str:
    """Return the end of what Ray says, without the stack."""
    lines = [line.strip() for line in str(problem).splitlines() if line.strip()]
    return one_line(lines[-1] if lines else type(problem).__name__, 200)
