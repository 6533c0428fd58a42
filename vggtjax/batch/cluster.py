"""Many clips on a cluster: Ray keeps workers alive, each with one model. Imports neither jax nor ray.

Ray is driven by a process of its own (`cluster_driver`): it prints as it likes, and ends its process where the cluster
dies. Outcomes come from there, nothing goes back.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vggtjax.batch.cluster_driver import drive
from vggtjax.batch.cluster_options import Cluster
from vggtjax.batch.cluster_worker import Job, Load
from vggtjax.batch.contact import contact_page
from vggtjax.batch.destination import LocalFolder, RemoteFolder, destination
from vggtjax.batch.recipe import BatchRecipe, ClipOutcome, counted, invalid_name
from vggtjax.errors import ClusterError, InputError, VggtjaxError, check_extra, one_line
from vggtjax.progress import Progress, no_progress
from vggtjax.storage.remote import is_in_process, is_url

_GOODBYE = 30  # seconds for Ray to end


def reconstruct_on_cluster(
    load: Load,
    sources: Mapping[str, str],
    out: str | Path,
    cluster: Cluster,
    recipe: BatchRecipe,
    *,
    progress: Progress | None = None,
    note: Callable[[str], None] | None = None,
) -> Generator[ClipOutcome]:
    """Reconstruct clips on a cluster, and yield the outcome of each as it is finished.

    A worker that ends costs the clips in its work: each is run again, alone on a worker, and fails where that one ends,
    too. A clip's folder appears whole or not at all, and finished clips are kept, also by a later run.

    Args:
        load: returns the model and the fitted rule of fusion, None for the paper's; it is pickled, and every worker
            calls it once, such as `functools.partial(...)` of a function in a module.
        sources: paths that the workers see, too, or URLs, by name.
        out: a folder that all machines share, or a URL.
        cluster: where.
        recipe: how.
        progress: called with the number of computed clips, and of all but kept and failed ones.
        note: called with a line for workers that begin or are lost.

    Raises:
        MissingExtraError: Ray is not installed.
        ClusterError: the cluster is not there, has no room for a worker, dies, or runs other code.
        InputError: an invalid option, or results of other settings.
        OutputError: the folder cannot be written, or another run is writing it.
    """
    check_extra("--engine ray", "cluster", "ray")
    place = destination(out)
    for url in (*sources.values(), *([place.url] if isinstance(place, RemoteFolder) else [])):
        if is_url(url) and is_in_process(url):
            raise InputError(f"{url} is in the memory of one process; expected a place that all workers reach")
    if isinstance(place, LocalFolder):
        place = LocalFolder(place.path.absolute())
    progress, note = progress or no_progress, note or (lambda text: None)
    odd = {name: outcome for name in sources if (outcome := invalid_name(name)) is not None}
    job = Job(load, recipe, place, os.getcwd(), cluster)  # noqa: PTH109 - text
    named = {name: source for name, source in sources.items() if name not in odd}
    with place.held(None), contact_page(place, len(sources)) as tell:
        for outcome in odd.values():
            tell(outcome)
            yield outcome
        if not named:
            return
        for outcome in counted(_outcomes(job, named, note), len(named), progress):
            tell(outcome)
            yield outcome


def _outcomes(job: Job, sources: Mapping[str, str], note: Callable[[str], None]) -> Generator[ClipOutcome]:
    """Yield the outcomes that the process which drives Ray sends, until all clips are done; raise its error."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "ray.log"
        with _driver(job, sources, log) as pipe:
            while True:
                try:
                    message = pipe.recv()
                except (EOFError, OSError):
                    words = _last_words(log)
                    raise ClusterError(
                        f"the cluster has died{words}; finished clips are kept: run the command again for the others"
                    ) from None
                if message is None:
                    return
                if isinstance(message, VggtjaxError):
                    raise message
                if isinstance(message, str):
                    note(message)
                else:
                    yield message


@contextmanager
def _driver(job: Job, sources: Mapping[str, str], log: Path) -> Iterator[Connection]:
    """Start the process that drives Ray, and end it; yields what it writes to."""
    context: Any = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe(duplex=False)
    process = context.Process(target=drive, args=(other, str(log), job, sources), name="vggtjax-ray", daemon=True)
    process.start()
    other.close()
    try:
        yield pipe
    finally:
        pipe.close()  # tells the process to end, if it has not
        process.join(_GOODBYE)
        process.terminate()
        process.join(_GOODBYE)
        process.kill()


def _last_words(log: Path) -> str:
    lines = log.read_text(errors="replace").splitlines() if log.is_file() else []
    said = next((line for line in reversed(lines) if line.strip()), "")
    return f" (Ray's last words: {one_line(said, 200)})" if said else ""
