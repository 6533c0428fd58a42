"""The command `vggtjax reconstruct`. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.clips.preprocessing import Framing
from vggtjax.clips.sampling import Sampling
from vggtjax.commands.arguments import Frames, Method, Output, ResultFolder, Size, Sources, View
from vggtjax.commands.models import ModelFiles
from vggtjax.commands.report import Report
from vggtjax.commands.view import serve
from vggtjax.errors import InputError
from vggtjax.options import Options
from vggtjax.results.saving import Saving
from vggtjax.storage.flags import InWords, Switch

if TYPE_CHECKING:
    import numpy as np

    from vggtjax.clips.clip import Clip


@dataclass(frozen=True)
class Known:
    """Masks and points of the user. Raises InputError for options that exclude each other."""

    masks: InWords[Path | None] = None
    """folder of pictures, one per frame, bright where something moves; mined from the clip by default"""
    no_masks: Switch = False
    """nothing moves: one pass is enough"""
    tracks: Annotated[str | None, tyro.conf.arg(metavar="GRID|FILE", help_behavior_hint="")] = None
    """points to follow: grid:20 for 20 x 20 over the first frame, or a CSV file with columns x, y and, if wanted,
    frame, in pixels of the source; none by default"""

    def __post_init__(self) -> None:
        if self.masks is not None and self.no_masks:
            raise InputError("--masks and --no-masks are opposites; give one of them")

    def check(self, options: Options) -> None:
        """Raise InputError for missing files, or for options that need mined masks."""
        if self.masks is not None or self.no_masks:
            options.check_given_masks()
        if self.masks is not None:
            from vggtjax.clips.sources import open_source

            open_source(str(self.masks))
        if self.tracks is not None:
            from vggtjax.clips.queries import check_words

            check_words(self.tracks)

    def masks_of(self, clip: Clip) -> np.ndarray | None:
        """Return the masks at the clip's frames, or None where they are mined."""
        import numpy as np

        from vggtjax.clips.masks import load_masks

        if self.no_masks:
            return np.zeros(clip.images.shape[:3], bool)
        return None if self.masks is None else load_masks(self.masks, clip)


def reconstruct(
    source: Sources,
    /,
    *,
    sampling: Frames = Sampling(),
    framing: Size = Framing(),
    files: Annotated[ModelFiles, tyro.conf.arg(name="model", help="")] = ModelFiles(),
    options: Method = Options(),
    known: Annotated[Known, tyro.conf.arg(name="mask and track", help="")] = Known(),
    out: ResultFolder,
    saving: Output = Saving(),
    view: View = False,
) -> None:
    """Cameras, depth, dynamic masks and a 4-D point cloud of a clip.

    Args:
        source: a folder of images, a pattern, images, or a video.
        sampling: which frames of the source
        framing: how frames are fitted to the model
        files: the model
        options: how the clip is reconstructed
        known: masks and points of your own
        out: folder for the result
        saving: how the result is written
        view: whether the viewer opens at the end
    """
    if not source:
        raise InputError("no input; name a folder of images, a pattern, images, or a video")
    frames = source[0] if len(source) == 1 else list(source)
    report = Report()
    with report.running():
        from vggtjax.clips.sources import open_source
        from vggtjax.results.folder import check_folder

        opened = open_source(frames)
        opened.total(sampling)
        next(opened.frames(Sampling()))  # finds a broken source before the model is loaded, which takes longer
        known.check(options)
        check_folder(out, saving.names(tracks=known.tracks is not None))
        network, fitted = files.load(report, options, [options.method])
        with report.stage("load clip") as progress:
            from vggtjax.clips.clip import read_clip
            from vggtjax.clips.queries import parse_queries
            from vggtjax.results.disk import announce, forecast_bytes

            fitter = framing.fitter(size=network.config.image_size, patch=network.config.patch_size)
            clip = read_clip(opened, sampling, fitter, progress)
            announce(out, forecast_bytes(clip.images.shape[:3], clip.source_size, saving))
            masks = known.masks_of(clip)
            queries = None if known.tracks is None else parse_queries(known.tracks, clip)
        report.note(_taken(clip, opened.total(Sampling())))
        from vggtjax.pipeline.run import reconstruct as run
        from vggtjax.results.report import RunFacts

        result = run(
            network,
            clip,
            options=options,
            size=fitter.size,
            masks=masks,
            tracks=queries,
            fusion=fitted,
            on_stage=report.stage,
        )
        with report.stage("write") as progress:
            pictures = clip.pictures() if saving.resolution == "original" else None
            facts = RunFacts(report.seconds)
            result.save(out, saving=saving, pictures=pictures, progress=progress, facts=facts)
    report.summary(result, out, network)
    if known.tracks is not None and "tracks" in network.untrained_heads:
        report.line("The track head of this model is untrained: its tracks show that everything runs, no more.")
    if view:
        serve(report, [result], [str(out)])


def _taken(clip: Clip, available: int | None) -> str:
    """Say which frames were taken, and at which size."""
    count, height, width = clip.images.shape[:3]
    source_height, source_width = clip.source_size[0]
    frames = f"{count}" if available in (None, count) else f"{count} of {available}"
    text = f"{frames} frames of {source_width} x {source_height} pixels, fitted to {width} x {height}"
    if clip.sampling.max_frames == count and available is not None and clip.sampling.start + count < available:
        spread = -(-(available - clip.sampling.start) // count)
        if clip.sampling.step < spread and clip.sampling.fps is None:
            text += f"; --stride {spread} spreads them over the whole source"
    return text
