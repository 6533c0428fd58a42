"""The process that drives Ray: workers are given clips, and begin again where they end. Imports Ray when it runs."""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vggtjax.batch.cluster_options import Cluster
from vggtjax.batch.cluster_worker import AT_ONCE, Job, Place, Started, Worker
from vggtjax.batch.recipe import failed
from vggtjax.errors import ClusterError, VggtjaxError, one_line
from vggtjax.storage.versions import running_versions

_TICK = 1.0  # seconds between looks at what Ray does not tell
_HEALTH = 10.0  # seconds between looks at this machine's part of the cluster
_PATIENCE = 60.0  # seconds without a worker before a word about it
_MOST_LOST_STARTS = 3  # times in a row that a worker ends before it is ready
_STORE_BYTES = 2**27  # of a new cluster's shared memory: clips do not pass through it
_GOODBYE = 10  # seconds for workers to tidy up


def drive(pipe: Connection, log: str, job: Job, sources: Mapping[str, str]) -> None:
    """Do a job; send notes (text) and outcomes, then None, or the error that ends the batch.

    Everything that Ray prints goes into a file.
    """
    with Path(log).open("wb", buffering=0) as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    import ray

    try:
        connect(job.cluster.address)
        Dispatcher(job, sources, pipe.send).run()
        pipe.send(None)
    except (BrokenPipeError, KeyboardInterrupt):  # nobody listens any more
        pass
    except VggtjaxError as error:
        pipe.send(error)
    finally:
        ray.shutdown()


def shared(nodes: Sequence[Mapping[str, float]], cluster: Cluster, devices: int = 1) -> tuple[int, int, float]:
    """Return the number of workers, and the CPUs and GPUs of each, where machines have so many "CPU" and "GPU".

    Raises ClusterError where no machine has room for a worker, unless their number is given: a cluster may grow.
    """
    gpus = cluster.worker_gpus
    if gpus is None:
        gpus = float(devices) if any(node.get("GPU", 0) for node in nodes) else 0.0
    counts = sorted(int(node.get("CPU", 0)) for node in nodes if node.get("CPU", 0) >= 1) or [0]
    if cluster.worker_cpus is not None:
        cpus = cluster.worker_cpus
    elif gpus:
        cpus = 1
    elif cluster.workers is None:
        cpus = max(1, counts[0])  # a worker on every machine
    else:
        cpus = max(1, min(counts[-1], sum(counts) // cluster.workers))
    room = sum(
        min(int(node.get("CPU", 0) // cpus), int(node.get("GPU", 0) // gpus) if gpus else int(node.get("CPU", 0)))
        for node in nodes
    )
    if cluster.workers is None and not room:
        has = " and ".join(f"{node.get('CPU', 0):g} CPUs, {node.get('GPU', 0):g} GPUs" for node in nodes[:4])
        needs = f"{cpus} CPU{'s' if cpus > 1 else ''}{f' and {gpus:g} GPUs' if gpus else ''}"
        raise ClusterError(
            f"no machine of the cluster has room for a worker, which takes {needs} ({has or 'no machine'}); "
            "give --worker-cpus and --worker-gpus that fit, or --workers for a cluster that grows"
        )
    return cluster.workers or room, cpus, gpus


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
    """A worker, and the clips in its work. Ray starts its process anew where it ends."""

    actor: Any
    place: Place | None = None
    ready: bool = False
    lost_starts: int = 0
    clips: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "a worker" if self.place is None else f"a worker ({self.place})"


class Dispatcher:
    """Gives clips to workers until every clip has an outcome."""

    def __init__(self, job: Job, sources: Mapping[str, str], send: Callable[[Any], None]) -> None:
        self._job, self._sources, self._send = job, sources, send
        self._waiting, self._again = deque(sources), deque[str]()
        self._lost = set[str]()  # clips that were in the work of a worker that ended
        self._slots: list[_Slot] = []
        self._tasks: dict[Any, tuple[_Slot, str | None]] = {}  # by Ray's reference; None: the worker's own start
        self._settings: tuple[Place, dict[str, Any]] | None = None
        self._threads: int | None = None

    def run(self) -> None:
        """Do all clips. Raises ClusterError and what beginning the batch raises."""
        import ray

        cluster = self._job.cluster
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        count, cpus, gpus = shared(nodes, cluster, self._job.recipe.devices)
        # Rounding goes by the number of threads, so only a number that the user gives limits them.
        self._threads = None if gpus else cluster.worker_cpus
        remote = ray.remote(Worker).options(
            num_cpus=cpus, num_gpus=gpus, max_restarts=-1, max_task_retries=0, max_concurrency=AT_ONCE + 1
        )
        self.begin([remote.remote() for _ in range(min(count, len(self._sources)))])
        checked = said = time.monotonic()
        while self._waiting or self._again or any(slot.clips for slot in self._slots):
            self.assign()
            done, _ = ray.wait(list(self._tasks), timeout=_TICK)
            for reference in done:
                self.finish(reference)
            now = time.monotonic()
            if now - checked > _HEALTH:
                checked = now
                _check_alive()
            if any(slot.ready for slot in self._slots):
                said = now
            elif now - said > _PATIENCE:
                said = now
                needs = f"{cpus} CPUs and {gpus:g} GPUs each"
                self._send(f"no worker has begun; the cluster is asked for {count} of {needs}")
        ray.wait([slot.actor.close.remote() for slot in self._slots], num_returns=len(self._slots), timeout=_GOODBYE)

    def begin(self, actors: Sequence[Any]) -> None:
        """Ask workers where they run."""
        for actor in actors:
            self._slots.append(_Slot(actor))
            self._tasks[actor.place.remote()] = (self._slots[-1], None)

    def assign(self) -> None:
        """Give clips to workers that have room, first to those with the least work; let go of those without.

        Clips of workers that ended come last, each alone, so that another end tells which clip it is.
        """
        deepest = AT_ONCE if len(self._waiting) >= len(self._slots) else 1
        for depth in range(deepest):
            for slot in [slot for slot in self._slots if slot.ready and len(slot.clips) == depth]:
                if self._waiting and self._lost.isdisjoint(slot.clips):
                    self._give(slot, self._waiting.popleft())
                elif self._again and not depth:
                    self._give(slot, self._again.popleft())
        for slot in [slot for slot in self._slots if slot.ready and not slot.clips]:
            slot.actor.close.remote()
            self._slots.remove(slot)  # Ray ends a worker that nobody names any more

    def _give(self, slot: _Slot, name: str) -> None:
        slot.clips.append(name)
        self._tasks[slot.actor.run.remote(name, self._sources[name])] = (slot, name)

    def finish(self, reference: Any) -> None:
        """Take the answer of a worker."""
        import ray
        from ray.exceptions import RayError, RayTaskError

        if reference not in self._tasks:  # a worker that is lost takes its other tasks along
            return
        slot, name = self._tasks.pop(reference)
        try:
            answer: Any = ray.get(reference)
        except RayTaskError as problem:  # no such model, or the worker has no such class
            known = isinstance(problem.cause, VggtjaxError)
            raise ClusterError(f"{slot} cannot begin: {problem.cause if known else _short(problem)}") from problem
        except RayError as problem:
            self._lose(slot, problem)
            return
        if name is not None:
            slot.clips.remove(name)
            # A clip that was lost and is there has been finished in this run.
            is_done = answer.status == "kept" and name in self._lost
            self._send(answer._replace(status="done") if is_done else answer)
        elif isinstance(answer, Place):
            slot.place = answer
            if answer.versions != running_versions():
                raise ClusterError(
                    f"{slot} runs {answer.versions}, this command {running_versions()}; "
                    "install the same on all machines"
                )
            self._tasks[slot.actor.start.remote(self._job, self._threads)] = (slot, None)
        else:
            self._admit(slot, answer)

    def _admit(self, slot: _Slot, answer: Started) -> None:
        """Give work to a worker from now on. Raises ClusterError where it would compute something else."""
        assert slot.place is not None
        if self._settings is None:
            self._job.out.begin(answer.settings)
            self._settings = slot.place, answer.settings
            if answer.warning:
                self._send(answer.warning)
        first, settings = self._settings
        if settings != answer.settings:
            names = [key for key in settings | answer.settings if settings.get(key) != answer.settings.get(key)]
            raise ClusterError(
                f"{slot} has another {', '.join(names)} than the one on {first}; give all the same files"
            )
        slot.ready, slot.lost_starts = True, 0
        count = sum(slot.ready for slot in self._slots)
        self._send(f"worker {count} of {len(self._slots)} is ready: {slot.place}")

    def _lose(self, slot: _Slot, problem: Exception) -> None:
        """Begin with a worker again that has ended; its clips are run again, or fail if they are run again already."""
        import ray

        self._tasks = {reference: task for reference, task in self._tasks.items() if task[0] is not slot}
        self._send(f"{slot} has ended; in its work: {', '.join(map(one_line, slot.clips)) or 'nothing'}")
        for clip in slot.clips:
            if clip in self._lost:
                self._send(failed(clip, ClusterError(f"two workers ended with it in their work: {_short(problem)}")))
            else:
                self._again.append(clip)
        self._lost.update(slot.clips)
        self._slots.remove(slot)
        lost_starts = 0 if slot.ready else slot.lost_starts + 1
        if lost_starts < _MOST_LOST_STARTS:
            self.begin([slot.actor])
            self._slots[-1].lost_starts = lost_starts
            return
        ray.kill(slot.actor)
        if not self._slots:
            raise ClusterError(f"workers ended {lost_starts} times in a row before they began: {_short(problem)}")


def _check_alive() -> None:
    """Raise ClusterError where this machine is no part of the cluster any more."""
    import ray

    own = ray.get_runtime_context().get_node_id()
    if not any(node["NodeID"] == own and node["Alive"] for node in ray.nodes()):
        raise ClusterError("this machine has left the cluster; finished clips are kept: run the command again")


def _short(problem: Exception) -> str:
    """Return the end of what Ray says, without the stack."""
    lines = [line.strip() for line in str(problem).splitlines() if line.strip()]
    return one_line(lines[-1] if lines else type(problem).__name__, 200)
