"""The command `vggtjax batch`: many clips, with the remaining time. Does not import jax before it is needed."""

from __future__ import annotations

import time
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.batch.cluster_options import Cluster
from vggtjax.clips.preprocessing import Framing
from vggtjax.commands.arguments import (
    BatchFolder,
    BatchMasks,
    Devices,
    Frames,
    Method,
    Output,
    PadFrames,
    Shards,
    Size,
    Sources,
    Unchecked,
)
from vggtjax.commands.models import ModelFiles, check_named, load_on_worker
from vggtjax.commands.report import Report
from vggtjax.errors import InputError, one_line
from vggtjax.known.options import KnownGeometry
from vggtjax.media.sampling import Sampling
from vggtjax.options import Options
from vggtjax.progress import Progress
from vggtjax.results.saving import Saving

if TYPE_CHECKING:
    from vggtjax.batch.recipe import ClipOutcome

_NOTHING_KNOWN, _HERE = KnownGeometry(), Cluster()


def batch(
    sources: Sources,
    /,
    *,
    sampling: Frames = Sampling(),
    framing: Size = Framing(),
    files: Annotated[ModelFiles, tyro.conf.arg(name="model", help="")] = ModelFiles(),
    options: Method = Options(),
    devices: Devices = 1,
    pad_frames: PadFrames = False,
    known: Annotated[KnownGeometry, tyro.conf.arg(name="known cameras and scale", help="")] = _NOTHING_KNOWN,
    unchecked: Unchecked = False,
    masks: BatchMasks = None,
    out: BatchFolder,
    saving: Output = Saving(),
    shard: Shards = None,
    cluster: Annotated[Cluster, tyro.conf.arg(name="cluster", help="")] = _HERE,
) -> None:
    """Reconstruct many clips, each into a folder of its own; run the same command again to resume.

    A clip that fails is named and does not stop the others; the exit code is 2 only if every clip fails.

    Args:
        sources: folders of images, videos, or captures of apps; a folder of such; or a list of them, .csv, .jsonl or
            .parquet; each a path or a URL.
        sampling: which frames of the source
        framing: how frames are fitted to the model
        files: the model
        options: how the clip is reconstructed
        devices: how many devices share the frames
        pad_frames: whether clips are padded to one of a few lengths
        known: cameras and lengths that all clips share, or that "source" names
        unchecked: whether the memory is left unchecked
        masks: what moves in each clip
        out: folder for the results
        saving: how the result is written
        shard: which part of the clips is done
        cluster: where the clips are reconstructed
    """
    report = Report()
    with report.running():
        from vggtjax.batch.shards import parse_shard
        from vggtjax.clips.sources import clips_by_name
        from vggtjax.known.given import check_readable
        from vggtjax.pipeline.devices import frames_mesh
        from vggtjax.refinement.refine import check_refinement

        check_refinement(options.refine_cameras)
        named = clips_by_name(sources)
        part = named if shard is None else parse_shard(shard).share(named)
        if not part:
            raise InputError(f"shard {shard} of {len(named)} clips has none; expected at most {len(named)} shards")
        if cluster.engine == "ray" and shard is not None:
            raise InputError("--engine ray and --shard exclude each other: workers share the clips themselves")
        known.check_many()
        check_readable(known)
        outcomes: list[ClipOutcome] = []

        def tell(outcome: ClipOutcome) -> None:
            outcomes.append(outcome)
            reason = f" ({outcome.reason})" if outcome.reason else ""
            report.note(f"{len(outcomes)}/{len(part)} {one_line(outcome.name)}: {outcome.status}{reason}{clock.left()}")

        if cluster.engine == "ray":
            from vggtjax.batch.cluster import reconstruct_on_cluster
            from vggtjax.batch.recipe import Recipe

            check_named(files.model)
            recipe = Recipe(options, framing, sampling, saving, known or None, pad_frames, devices, unchecked, masks)
            load = partial(load_on_worker, files, options)
            with report.stage("clips") as show:
                clock = _Clock(show)
                run = reconstruct_on_cluster(
                    load, named, out, cluster, recipe, progress=clock.progress, note=report.note
                )
                for outcome in run:
                    tell(outcome)
            warning = ""  # a worker has said it
        else:
            frames_mesh(devices)
            network, fitted = files.load(report, options, [options.method])
            from vggtjax.batch.many import reconstruct_many

            with report.stage("frames") as show:
                clock = _Clock(show)
                for outcome in reconstruct_many(
                    network,
                    named,
                    out,
                    options=options,
                    framing=framing,
                    sampling=sampling,
                    saving=saving,
                    fusion=fitted,
                    known=known,
                    pad_frames=pad_frames,
                    masks=masks,
                    shard=shard,
                    devices=devices,
                    unchecked=unchecked,
                    progress=clock.progress,
                ):
                    tell(outcome)
            warning = network.warning
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
    """The remaining time of a batch, from the mean time of the frames done."""

    def __init__(self, show: Progress) -> None:
        self._show, self._started = show, time.perf_counter()
        self._seconds: float | None = None

    def progress(self, done: int, total: int | None) -> None:
        """Show the frames done and all frames."""
        self._show(done, total)
        self._seconds = (time.perf_counter() - self._started) * (total / done - 1) if done and total else None

    def left(self) -> str:
        """Return words for the remaining time; none before the first frame is done, or below half a second."""
        left = timedelta(seconds=round(self._seconds or 0))
        return f", {left} left" if left else ""
