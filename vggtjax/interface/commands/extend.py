"""The command `vggtjax extend`. Does not import jax before it is needed."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError
from vggtjax.interface.commands.arguments import ResultFolder, ResultPath
from vggtjax.interface.commands.flags import InWords, Switch
from vggtjax.interface.commands.models import ModelFiles
from vggtjax.interface.commands.report import Report
from vggtjax.results.saving import Saving
from vggtjax.storage.interruption import handled

if TYPE_CHECKING:
    from vggtjax.clips.media.sampling import Source
    from vggtjax.results.reconstruction import Reconstruction

_CLIP = tyro.conf.arg(metavar="CLIP [CLIP ...]", help_behavior_hint="(required)")
_QUIET = 3.0  # seconds without a new picture, after which those that have come are added
_POLL = 0.5  # seconds


def extend(
    result: ResultPath,
    clip: Annotated[tuple[str, ...], tyro.conf.Positional, _CLIP],
    /,
    *,
    files: Annotated[ModelFiles, tyro.conf.arg(name="model", help="")] = ModelFiles(),
    sampling: Annotated[Sampling, tyro.conf.arg(name="input", help="")] = Sampling(),
    saving: Annotated[Saving, tyro.conf.arg(name="output", help="")] = Saving(),
    out: ResultFolder,
    prefix: InWords[str] = "",
    window: int = 32,
    anchors: int = 8,
    watch: Switch = False,
) -> None:
    """Add frames of the same place to a finished result, in its frame and scale.

    The old frames stay as they are. Frames of the result that show the place of the new ones are its anchors: new
    frames are run together with them and joined by their depth and cameras. The result itself is not changed.

    Args:
        result: folder of a result.
        clip: a folder of images, a pattern, images, a video, or a capture, as for vggtjax reconstruct.
        files: the model that made the result
        sampling: which frames are taken
        saving: what is written
        out: folder for the new result
        prefix: letters before the names of the new frames, such as day2_, where they have names of old ones.
        window: frames that are run together, anchors and new ones.
        anchors: how many of them are frames of the result, at least 3.
        watch: CLIP is a folder that still fills, such as that of a capture that is running: add pictures as they come,
            until Ctrl-C. vggtjax view OUT shows the growing scene.
    """
    if not clip:
        raise InputError("no new frames; name a folder of images, a pattern, images, or a video")
    source = clip[0] if len(clip) == 1 else list(clip)
    if watch and not Path(clip[0]).is_dir():
        raise InputError(f"--watch is for a folder that fills with pictures, and {clip[0]} is no folder")
    if out.resolve() == (result if result.is_dir() else result.parent).resolve():
        raise InputError(f"--out is {out}, the folder of the result, which stays as it is; choose another folder")
    report = Report()
    with report.running():
        from vggtjax.clips.clip import read_clip
        from vggtjax.clips.sources import open_source
        from vggtjax.pipeline.windows import extend as extending
        from vggtjax.pipeline.windows.plan import Windows
        from vggtjax.results.folder import check_folder
        from vggtjax.results.reconstruction import Reconstruction
        from vggtjax.results.report import RunFacts

        how = extending.Extending(prefix, Windows(window, anchors))
        with report.stage("read"):
            old = Reconstruction.load(result)
        check_folder(out, saving.names(tracks=old.track_frames is not None))
        options = extending.options_of(old)
        opened = None if watch else open_source(source)
        model, fusion = files.load(report, options, [options.method])
        extending.check_result(model, old)
        fitter = extending.fitter_of(old)

        def grown(old: Reconstruction, new: Source) -> Reconstruction:
            with report.stage("load clip") as progress:
                read = read_clip(new, sampling, fitter, progress)
            joined = extending.extend(
                model, old, read, out=out, extending=how, options=options, fusion=fusion, on_stage=report.stage
            )
            with report.stage("write") as progress:
                joined.save(out, saving=saving, progress=progress, facts=RunFacts(report.seconds))
            return joined

        old = _watched(Path(clip[0]), old, grown, prefix, report) if opened is None else grown(old, opened)
    report.summary(old, out, model)


def _watched(
    folder: Path, result: Reconstruction, grown: Callable[..., Reconstruction], prefix: str, report: Report
) -> Reconstruction:
    """Add pictures to the result as they come into a folder, until Ctrl-C; those that do not fit yet wait for more."""
    from vggtjax.clips.media.images import ImageFiles, is_image_name
    from vggtjax.clips.media.order import in_order

    report.note(f"waiting for pictures in {folder}; Ctrl-C ends it")
    sizes: dict[Path, int] = {}
    tried, since = 0, time.monotonic()
    try:
        while True:
            known = set(result.frame_names)
            now = {p: p.stat().st_size for p in folder.iterdir() if is_image_name(p) and prefix + p.stem not in known}
            if now != sizes:
                sizes, since = now, time.monotonic()
            if len(now) == tried or time.monotonic() - since < _QUIET:
                time.sleep(_POLL)
                continue
            tried = len(now)
            try:
                result = grown(result, ImageFiles(tuple(in_order(now))))
            except InputError as error:
                report.note(f"{tried} pictures wait for others: {error}")
            else:
                tried = 0
                report.note(f"the result has {len(result.depth)} frames")
    except KeyboardInterrupt:
        handled()
        return result
