"""Many clips on a cluster of Ray: an actor a worker, a call a clip, Ray's own retries. Imports neither jax nor ray."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from vggtjax.errors import ClusterError, InputError, VggtjaxError, check_extra, one_line
from vggtjax.pipeline.batch.contact import contact_page
from vggtjax.pipeline.batch.destination import Destination, LocalFolder, destination
from vggtjax.pipeline.batch.recipe import BatchRecipe, ClipOutcome, counted, failed, invalid_name
from vggtjax.pipeline.batch.worker import Load, Worker
from vggtjax.progress import Progress, no_progress
from vggtjax.storage.json_values import Count, check_fields
from vggtjax.storage.remote import is_in_process, is_url
from vggtjax.storage.versions import running_versions

Note = Callable[[str], None]
_PATIENCE = 60.0  # seconds without a worker before a word about it


@dataclass(frozen=True)
class Cluster:
    """Where a batch runs. Raises InputError for an invalid value, or for options without an engine that reads them.

    Attributes:
        engine: local: in this process; ray: on a cluster of Ray
        address: of the cluster, as host:port; auto: the one that runs on this machine; RAY_ADDRESS, or a new one of
            this machine alone, by default
        workers: how many workers, each with a model of its own; as many as the cluster has room for by default
        worker_cpus: CPUs of a worker; by default all of a machine, or 1 beside a GPU
        worker_gpus: GPUs of a worker; by default as many as --devices, if the cluster has any
    """

    engine: Literal["local", "ray"] = "local"
    address: str | None = None
    workers: Count | None = None
    worker_cpus: Count | None = None
    worker_gpus: Annotated[float, Meta(ge=0, le=1024)] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("address", "workers", "worker_cpus", "worker_gpus"):
            if self.engine == "local" and getattr(self, name) is not None:
                raise InputError(f"--{name.replace('_', '-')} needs --engine ray")
        if self.address is not None and self.address.startswith("ray://"):
            raise InputError(f"address is {self.address}; expected host:port; run this on a machine of the cluster")


def reconstruct_on_cluster(
    load: Load,
    sources: Mapping[str, str],
    out: str | Path,
    cluster: Cluster,
    recipe: BatchRecipe,
    *,
    progress: Progress | None = None,
    note: Note | None = None,
) -> Generator[ClipOutcome]:
    """Reconstruct clips on a cluster, and yield the outcome of each as it is finished.

    A clip in whose work a worker ends is run again by Ray, and fails where that ends a worker, too. Finished clips are
    kept, also by a later run. Every worker calls the pickled `load` once; it returns the model and the fitted rule of
    fusion. All machines see `sources` (paths or URLs, by name) and `out`. `note` gets a line for the first worker.

    Raises MissingExtraError without Ray, and for URLs without fsspec; ClusterError where the cluster is not there, has
    no room for a worker, or runs other code; InputError for an invalid option, or results of other settings;
    OutputError.
    """
    check_extra("--engine ray", "cluster", "ray")
    urls = [url for url in (*sources.values(), str(out)) if is_url(url)]
    if urls:
        check_extra("a clip or a folder at a URL", "remote", "fsspec")
    if (inside := next(filter(is_in_process, urls), None)) is not None:
        raise InputError(f"{inside} is in the memory of one process; expected a place that all workers reach")
    place = destination(out)
    if isinstance(place, LocalFolder):
        place = LocalFolder(place.path.absolute())
    odd = {name: outcome for name in sources if (outcome := invalid_name(name)) is not None}
    named = {name: source for name, source in sources.items() if name not in odd}
    with place.held(None), contact_page(place, len(sources)) as tell:
        computed = _computed(load, named, place, cluster, recipe, note or (lambda text: None)) if named else ()
        for outcome in chain(odd.values(), counted(computed, len(named), progress or no_progress)):
            tell(outcome)
            yield outcome


def _computed(
    load: Load, sources: Mapping[str, str], out: Destination, cluster: Cluster, recipe: BatchRecipe, note: Note
) -> Generator[ClipOutcome]:
    """Give each worker that is ready a clip, until every clip has an outcome; the cluster takes back idle workers."""
    _connect(cluster.address)
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        count, cpus, gpus = shared(nodes, cluster, recipe.devices)
        # Rounding goes by the number of threads, so only a number that the user gives limits them.
        given = load, recipe, out, os.getcwd(), None if gpus else cluster.worker_cpus  # noqa: PTH109 - text
        remote: Any = ray.remote(Worker)
        actor = remote.options(num_cpus=cpus, num_gpus=gpus, max_restarts=-1, max_task_retries=1)
        new = (actor.remote(*given) for _ in range(min(count, len(sources))))
        calls: dict[Any, tuple[Any, str | None]] = {worker.ready.remote(): (worker, None) for worker in new}
        waiting, left, first = iter(sources.items()), len(sources), None
        while left:
            done, _ = ray.wait(list(calls), timeout=_PATIENCE)
            if not done and first is None:
                each = f"{cpus} CPUs and {gpus:g} GPUs each"
                note(f"no worker has started; the cluster is asked for {count} workers with {each}")
            for call in done:
                worker, name = calls.pop(call)
                try:
                    answer = ray.get(call)
                except RayError as problem:  # the worker's process ended twice, or never began
                    said = _short(problem)
                    if name is not None:
                        answer = failed(name, ClusterError(f"the worker process died twice on this clip: {said}"))
                    elif calls and not isinstance(problem, RayTaskError):  # the others go on
                        note(f"a worker ended before it was ready: {said}")
                        continue
                    else:
                        raise ClusterError(f"a worker cannot start: {said}") from problem
                if isinstance(answer, ClipOutcome):
                    left -= 1
                    yield answer
                else:
                    first = _checked(answer, first, out, note)
                if (clip := next(waiting, None)) is not None:
                    calls[worker.run.remote(*clip)] = worker, clip[0]
                del worker  # without a handle Ray ends it
    finally:
        ray.shutdown()


def _checked(ready: Any, first: Any, out: Destination, note: Note) -> Any:
    """Begin with the first worker that is ready, and return it. Raises ClusterError for one that differs from it."""
    versions, settings, warning = ready
    if versions != running_versions():
        raise ClusterError(
            f"a worker runs {versions}, this command {running_versions()}; install the same versions on all machines"
        )
    if first is None:
        out.begin(settings)
        note(warning or "the first worker is ready")
    elif names := [key for key in settings | first[1] if settings.get(key) != first[1].get(key)]:
        raise ClusterError(f"two workers have different {', '.join(names)}; give all the same files")
    return first or ready


def _connect(address: str | None) -> None:
    """Join the cluster at an address, or start one of this machine. Raises ClusterError where there is none."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    address = address or os.environ.get("RAY_ADDRESS") or "local"
    options: dict[str, Any] = {"include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **options)
    except Exception as problem:  # ConnectionError, RuntimeError, ValueError, ...: Ray has no common one
        raise ClusterError(
            f"no cluster at {address} can be joined ({_short(problem)}); start one with: ray start --head"
        ) from problem
    from ray._private import worker

    worker._worker_logs_enabled = False  # else it prints a line into our table for each worker that ends


def shared(nodes: Sequence[Mapping[str, float]], cluster: Cluster, devices: int = 1) -> tuple[int, int, float]:
    """Return the number of workers, and the CPUs and GPUs of each, where machines have so many "CPU" and "GPU".

    Raises ClusterError where no machine has room for a worker, unless their number is given: a cluster may grow.
    """
    counts = sorted(int(node.get("CPU", 0)) for node in nodes if node.get("CPU", 0) >= 1) or [0]
    gpus = cluster.worker_gpus
    if gpus is None:
        gpus = float(devices) if any(node.get("GPU", 0) for node in nodes) else 0.0
    most = counts[0] if cluster.workers is None else min(counts[-1], sum(counts) // cluster.workers)
    cpus = cluster.worker_cpus or (1 if gpus else max(1, most))
    room = sum(int(min(node.get("CPU", 0) // cpus, node.get("GPU", 0) // gpus if gpus else 1e9)) for node in nodes)
    if cluster.workers is None and not room:
        has = " and ".join(f"{node.get('CPU', 0):g} CPUs, {node.get('GPU', 0):g} GPUs" for node in nodes[:4])
        raise ClusterError(
            f"no machine of the cluster has room for {cpus} CPUs and {gpus:g} GPUs of a worker ({has or 'none'}); "
            "give --worker-cpus and --worker-gpus that fit, or --workers for a cluster that grows"
        )
    return cluster.workers or room, cpus, gpus


def _short(problem: Exception) -> str:
    """Return the end of what Ray says, without the stack; or the sentence of an error of ours that it tells."""
    if isinstance(cause := getattr(problem, "cause", None), VggtjaxError):
        return str(cause)
    lines = [line.strip() for line in str(problem).splitlines() if line.strip()]
    return one_line(lines[-1] if lines else type(problem).__name__, 200)
