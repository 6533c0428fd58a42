"""The command `vggtjax reconstruct`. Does not import jax before it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import tyro

from vggtjax.clips.preprocessing import Framing
from vggtjax.clips.sampling import Sampling
from vggtjax.commands.arguments import Devices, Frames, Method, Output, ResultFolder, Size, Sources, View
from vggtjax.commands.models import ModelFiles
from vggtjax.commands.report import Report
from vggtjax.commands.view import serve
from vggtjax.errors import InputError
from vggtjax.known.options import KnownGeometry
from vggtjax.options import Options
from vggtjax.results.saving import Saving
from vggtjax.storage.flags import InWords, Switch
from vggtjax.windows.plan import Windows

if TYPE_CHECKING:
    import numpy as np

    from vggtjax.checkpoint import Model
    from vggtjax.clips.clip import Clip
    from vggtjax.clips.preprocessing import Fitter
    from vggtjax.clips.sampling import Source
    from vggtjax.method.fusion_family import FusionParams
    from vggtjax.results.reconstruction import Reconstruction


_NOTHING_KNOWN = KnownGeometry()


@dataclass(frozen=True)
class More:
    """Options in groups of their own. Raises InputError for options that exclude each other."""

    geometry: Annotated[KnownGeometry, tyro.conf.arg(name="known cameras and scale", help="")] = _NOTHING_KNOWN
    windows: Annotated[Windows, tyro.conf.arg(name="long clip", help="")] = Windows()

    def __post_init__(self) -> None:
        if self.windows.window and self.geometry:
            raise InputError(
                "known cameras or lengths and --window exclude each other: they are brought into a clip "
                "that is run as a whole"
            )


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

    def check(self, options: Options, windows: Windows) -> None:
        """Raise InputError for missing files, for options that need mined masks, or for points and windows."""
        if self.tracks is not None and windows.window:
            raise InputError("--tracks and --window exclude each other: points are followed over all frames at once")
        if options.refine_cameras and windows.window:
            raise InputError("--refine-cameras and --window exclude each other: cameras are adjusted over all frames")
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
    devices: Devices = 1,
    known: Annotated[Known, tyro.conf.arg(name="mask and track", help="")] = Known(),
    more: Annotated[More, tyro.conf.arg(name="", help="")] = More(),
    out: ResultFolder,
    saving: Output = Saving(),
    view: View = False,
) -> None:
    """Cameras, depth, dynamic masks and a 4-D point cloud of a clip.

    Args:
        source: a folder of images, a pattern, images, a video, or a capture of an app (Record3D, COLMAP, ...).
        sampling: which frames of the source
        framing: how frames are fitted to the model
        files: the model
        options: how the clip is reconstructed
        devices: how many devices share the frames
        known: masks and points of your own
        more: known cameras and lengths, and how a long clip is cut
        out: folder for the result
        saving: how the result is written
        view: whether the viewer opens at the end
    """
    if not source:
        raise InputError("no input; name a folder of images, a pattern, images, or a video")
    if devices > 1 and more.windows.window:
        raise InputError("--devices and --window exclude each other: a window is run on one device")
    if devices > 1 and known.tracks is not None:
        raise InputError("--devices and --tracks exclude each other: points are followed on one device")
    frames = source[0] if len(source) == 1 else list(source)
    report = Report()
    with report.running():
        from vggtjax.clips.sources import open_source
        from vggtjax.known.given import check_readable
        from vggtjax.pipeline.devices import frames_mesh
        from vggtjax.refinement.refine import check_refinement
        from vggtjax.results.folder import check_folder

        opened = open_source(frames)
        opened.total(sampling)
        next(opened.frames(Sampling()))  # finds a broken source before the model is loaded, which takes longer
        windows, geometry = more.windows, more.geometry
        known.check(options, windows)
        check_refinement(options.refine_cameras, geometry.poses is not None)
        check_readable(geometry)
        frames_mesh(devices)
        check_folder(out, saving.names(tracks=known.tracks is not None))
        network, fitted = files.load(report, options, [options.method])
        fitter = framing.fitter(size=network.config.image_size, patch=network.config.patch_size)
        reading = Reading(opened, sampling, fitter)
        if devices > 1:  # which share the memory that a clip needs
            count = None
        elif windows.window is None:
            needs = {
                "--tracks": known.tracks,
                "known cameras or lengths": geometry,
                "--refine-cameras": options.refine_cameras,
            }
            at_once = [name for name, given in needs.items() if given]
            windows, count = _chosen(report, reading, network, out, at_once)
        else:
            count = _cut_frames(report, opened, sampling, windows)
        if count is not None:
            from vggtjax.windows.run import LongRun, reconstruct_long

            plan = LongRun(windows, count, sampling, fitter, saving, on_stage=report.stage)
            masks = False if known.no_masks else known.masks
            result = reconstruct_long(
                network, frames, out, windows, options=options, long_run=plan, fusion=fitted, masks=masks
            )
        else:
            result = _together(report, reading, network, fitted, (options, devices), known, geometry, out, saving)
    report.summary(result, out, network)
    if known.tracks is not None and "tracks" in network.untrained_heads:
        report.line("The track head of this model is untrained: its tracks show that everything runs, no more.")
    if view:
        serve(report, [result], [str(out)])


class Reading(NamedTuple):
    """How the frames of a clip are read."""

    source: Source
    sampling: Sampling
    fitter: Fitter


def _together(
    report: Report,
    reading: Reading,
    network: Model,
    fitted: FusionParams | None,
    how: tuple[Options, int],
    known: Known,
    geometry: KnownGeometry,
    out: Path,
    saving: Saving,
) -> Reconstruction:
    """Reconstruct all frames of a clip at once with some options on some devices, and write the result."""
    (opened, sampling, fitter), (options, devices) = reading, how
    with report.stage("load clip") as progress:
        from vggtjax.clips.clip import read_clip
        from vggtjax.clips.queries import parse_queries
        from vggtjax.results.disk import announce, forecast_bytes

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
        known=geometry,
        devices=devices,
        on_stage=report.stage,
    )
    with report.stage("write") as progress:
        pictures = clip.pictures() if saving.resolution == "original" else None
        result.save(out, saving=saving, pictures=pictures, progress=progress, facts=RunFacts(report.seconds))
    return result


def _cut_frames(report: Report, opened: Source, sampling: Sampling, windows: Windows) -> int | None:
    """Return the number of frames of a clip that is cut into windows; None for one that is run as a whole."""
    if not windows.window:
        return None
    from vggtjax.windows.frames import count_frames

    with report.stage("count frames"):
        count = count_frames(opened, sampling)
    if not windows.cuts(count):
        report.note(f"the clip has {count} frames, no more than a window of {windows.window}: all are run together")
        return None
    report.note(f"{count} frames in windows of {windows.window} that share at least {windows.shared}")
    return count


def _chosen(
    report: Report, reading: Reading, network: Model, out: Path, at_once: Sequence[str]
) -> tuple[Windows, int | None]:
    """Return windows and the number of frames of a clip that does not fit in memory, or that was begun in windows.

    `at_once` names options that need all frames together: the clip is then not cut.
    """
    from vggtjax.windows.choice import choose_windows
    from vggtjax.windows.store import unfinished_cut

    begun = unfinished_cut(out)
    if begun is not None and not at_once:
        windows = Windows(*begun)
        report.note(f"{out} holds a run in windows that was stopped: it goes on; --window 0 runs all frames together")
        return windows, _cut_frames(report, reading.source, reading.sampling, windows)
    with report.stage("check memory"):
        choice = choose_windows(network, *reading)
    if choice is None:
        return Windows(), None
    if at_once:
        verb = "needs" if len(at_once) == 1 else "need"
        report.note(f"{choice.sizes}, but {' and '.join(at_once)} {verb} all frames at once: they are run together")
        return Windows(), None
    report.note(choice.sentence)
    return choice.windows, choice.frames if choice.windows.cuts(choice.frames) else None


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
