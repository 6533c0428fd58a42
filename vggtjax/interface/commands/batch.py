"""The command `vggtjax batch`: many clips, with the remaining time. Does not import jax before it is needed."""

from __future__ import annotations

import time
from datetime import timedelta
from functools import partial
from typing import Annotated

import tyro

from vggtjax.errors import InputError, one_line
from vggtjax.interface.commands.arguments import CONSISTENT, BatchFolder, Shards, Sources
from vggtjax.interface.commands.models import ModelFiles, check_named, load_on_worker
from vggtjax.interface.commands.report import Report
from vggtjax.pipeline.batch.cluster import Cluster
from vggtjax.pipeline.batch.recipe import BatchRecipe, ClipOutcome
from vggtjax.progress import Progress
from vggtjax.storage.interruption import kept


def batch(
    sources: Sources,
    /,
    *,
    files: Annotated[ModelFiles, tyro.conf.arg(name="model", help="")] = ModelFiles(),
    recipe: Annotated[BatchRecipe, tyro.conf.arg(name="", help="")] = BatchRecipe(options=CONSISTENT),
    out: BatchFolder,
    shard: Shards = None,
    cluster: Annotated[Cluster, tyro.conf.arg(name="cluster", help="")] = Cluster(),
) -> None:
    """Reconstruct many clips, each into a folder of its own; run the same command again to resume.

    A clip that fails is named and does not stop the others; the exit code is 2 only if every clip fails.

    Args:
        sources: folders of images, videos, or captures of apps; a folder of such; or a list of them, .csv, .jsonl or
            .parquet; each a path or a URL.
        files: the model
        recipe: how clips are read, reconstructed and written
        out: folder for the results
        shard: which part of the clips is done
        cluster: where the clips are reconstructed
    """
    report = Report()
    with report.running():
        from vggtjax.clips.sources import clips_by_name
        from vggtjax.pipeline.batch.shards import parse_shard
        from vggtjax.pipeline.devices import frames_mesh

        named = clips_by_name(sources)
        part = named if shard is None else parse_shard(shard).share(named)
        if not part:
            raise InputError(f"shard {shard} of {len(named)} clips has none; expected at most {len(named)} shards")
        if cluster.engine == "ray" and shard is not None:
            raise InputError("--engine ray and --shard exclude each other: workers share the clips themselves")
        recipe.check(named)
        if cluster.engine == "ray":
            from vggtjax.pipeline.batch.cluster import reconstruct_on_cluster

            check_named(files.model)
            load = partial(load_on_worker, files, recipe.options)
            run = partial(reconstruct_on_cluster, load, named, out, cluster, recipe, note=report.note)
            warning = ""  # a worker says it
        else:
            from vggtjax.pipeline.batch.many import reconstruct_many

            frames_mesh(recipe.devices)
            network, fitted = files.load(report, recipe.options, [recipe.options.method])
            run = partial(reconstruct_many, network, named, out, recipe=recipe, fusion=fitted, shard=shard)
            warning = network.warning
        outcomes: list[ClipOutcome] = []

        def stopped() -> str:
            return f"{len(outcomes)} of {len(part)} clips are finished or failed; run the same command again to resume"

        with kept(stopped), report.stage("clips") as show:
            clock = _Clock(show)
            for outcome in run(progress=clock.progress):
                outcomes.append(outcome)
                reason = f" ({outcome.reason})" if outcome.reason else ""
                name = f"{len(outcomes)}/{len(part)} {one_line(outcome.name)}"
                report.note(f"{name}: {outcome.status}{reason}{clock.left()}")
    counts = {status: sum(outcome.status == status for outcome in outcomes) for status in ("done", "kept", "failed")}
    report.table({"clips": len(outcomes), **counts, "results": f"{out}/"})
    for outcome in outcomes:
        if outcome.status == "failed":
            report.line(f"{one_line(outcome.name)} failed: {outcome.reason}")
    if warning:
        report.line(warning)
    if counts["failed"] == len(outcomes):
        raise InputError("none of the clips could be reconstructed; the reasons are above")


class _Clock:
    """The remaining time of a batch, from the mean time of the clips done."""

    def __init__(self, show: Progress) -> None:
        self._show, self._started = show, time.perf_counter()
        self._seconds: float | None = None

    def progress(self, done: int, total: int | None) -> None:
        """Show the clips done and all clips."""
        self._show(done, total)
        self._seconds = (time.perf_counter() - self._started) * (total / done - 1) if done and total else None

    def left(self) -> str:
        """Return words for the remaining time; none before the first clip is done, or below half a second."""
        left = timedelta(seconds=round(self._seconds or 0))
        return f", {left} left" if left else ""
