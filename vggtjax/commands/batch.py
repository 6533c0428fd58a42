"""What `vggtjax batch` does: many clips, with the time that is left."""

from __future__ import annotations

import time
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.commands.report import Advance, Report
from vggtjax.errors import InputError
from vggtjax.options import MethodName


def batch(
    sources: tyro.conf.Positional[tuple[str, ...]],
    /,
    out: Path,
    *,
    model: str = "demo",
    method: MethodName = "4dvggt-d",
    mode: Literal["crop", "pad"] = "crop",
    size: int | None = None,
    fps: float | None = None,
    stride: int = 1,
    start: int = 0,
    max_frames: int | None = None,
    fusion: Path | None = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
    pad_frames: bool = False,
    confidence_percentile: float = 20.0,
    resolution: Literal["model", "original"] = "model",
    layout: Annotated[Literal["vggtjax", "vggt4d"], tyro.conf.arg(name="format")] = "vggtjax",
) -> None:
    """Reconstruct many clips, each into a folder of its own; run it again, and it goes on where it was interrupted.

    A clip that fails is named and does not stop the others; the exit code is 2 only where every clip fails.

    Args:
        sources: folders of images, or videos; or one folder of such.
        out: folder for the results, one folder for each clip, named after it.
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id.
        method: which passes give depth and cameras.
        mode: "crop" cuts tall frames, "pad" keeps every pixel and pads to a square.
        size: side in pixels to run at; the model's own by default.
        fps: frames per second to take of a video.
        stride: take every stride-th frame.
        start: index of the first frame to take.
        max_frames: take so many frames at most.
        fusion: file of a fitted rule of fusion, as vggtjax fit-fusion writes it; the paper's rule by default.
        dtype: of the blocks' matrix products.
        pad_frames: pad clips to one of a few lengths, so that those of similar length share a compilation: worth it for
            many lengths on a GPU, where compiling takes longer than running.
        confidence_percentile: leave so many percent of the pixels, the least confident, out of the point clouds.
        resolution: of the files: the model's, or the source's own.
        layout: "vggt4d" writes, beside our own files, the folder vggt4d/ as VGGT4D does.
    """
    report = Report()
    with report.running():
        from vggtjax.clips.sampling import Sampling
        from vggtjax.clips.sources import clips_by_name
        from vggtjax.results.point_cloud import check_percentile

        Sampling(start, stride, fps, max_frames)
        check_percentile(confidence_percentile)
        named = clips_by_name(sources)
        options: dict[str, object] = {"method": method, "compute_dtype": dtype}
        options |= {"pad_frames": True} if pad_frames else {}
        if fusion is not None:
            from vggtjax.method.fusion_file import read_fusion

            options["fusion"] = read_fusion(fusion, [method])
        with report.stage("load model") as progress:
            from vggtjax.pretrained.load import load_model

            loaded = load_model(model, progress=progress)
        if fusion is not None:
            from vggtjax.method.fusion_file import warn_if_fitted_otherwise

            warn_if_fitted_otherwise(fusion, loaded, align_scale=False, mask_pairs=5)
        from vggtjax.pipeline.batch import reconstruct_many

        found = []
        with report.stage("frames") as show:
            clock = _Clock(show)
            for outcome in reconstruct_many(
                loaded,
                named,
                out,
                mode=mode,
                size=size,
                sampling={"fps": fps, "stride": stride, "start": start, "max_frames": max_frames},
                options=options,
                saving={"confidence_percentile": confidence_percentile, "resolution": resolution, "layout": layout},
                progress=clock.progress,
            ):
                found.append(outcome)
                reason = f" ({outcome.reason})" if outcome.reason else ""
                report.note(f"{len(found)}/{len(named)} {outcome.name}: {outcome.status}{reason}{clock.left()}")
    counts = {status: sum(outcome.status == status for outcome in found) for status in ("done", "kept", "failed")}
    report.table({"clips": len(found), **counts, "results": f"{out}/"})
    for outcome in found:
        if outcome.status == "failed":
            report.line(f"{outcome.name} failed: {outcome.reason}")
    if counts["failed"] == len(found):
        raise InputError("none of the clips could be reconstructed; the reasons are above")


class _Clock:
    """How long a batch goes on: what is left takes as long for each frame as what is done."""

    def __init__(self, show: Advance) -> None:
        self._show, self._started = show, time.perf_counter()
        self._seconds: float | None = None

    def progress(self, done: int, total: int) -> None:
        """Take the frames done and all of them, and show them."""
        self._show(done, total)
        self._seconds = (time.perf_counter() - self._started) * (total / done - 1) if done else None

    def left(self) -> str:
        """Return words for the time that is left, or none while no frame is done."""
        return "" if self._seconds is None else f", {timedelta(seconds=round(self._seconds))} left"
