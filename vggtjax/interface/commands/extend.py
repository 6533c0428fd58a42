"""The command `vggtjax extend`. Does not import jax before it is needed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError
from vggtjax.interface.commands.arguments import ResultFolder, ResultPath
from vggtjax.interface.commands.flags import Switch
from vggtjax.interface.commands.models import ModelFiles
from vggtjax.interface.commands.report import Report
from vggtjax.pipeline.windows.plan import Extending
from vggtjax.results.saving import Saving
from vggtjax.storage.interruption import handled

if TYPE_CHECKING:
    from vggtjax.clips.preprocessing import Fitter
    from vggtjax.clips.sources import ClipSource
    from vggtjax.results.reconstruction import Reconstruction

_CLIP = tyro.conf.arg(metavar="CLIP [CLIP ...]", help_behavior_hint="(required)")
_QUIET = 3.0  # seconds without a change, after which a picture is whole
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
    extending: Annotated[Extending, tyro.conf.arg(name="windows", help="")] = Extending(),
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
        extending: how the new frames are named, run and joined
        watch: CLIP is a folder that still fills, such as that of a capture that is running: add pictures as they come,
            until Ctrl-C. vggtjax view OUT shows the growing scene.
    """
    if not clip:
        raise InputError("no new frames; name a folder of images, a pattern, images, or a video")
    if watch:
        _check_watch(clip, sampling)
    if out.resolve() == (result if result.is_dir() else result.parent).resolve():
        raise InputError(f"--out is {out}, the folder of the result, which stays as it is; choose another folder")
    report = Report()
    with report.running():
        from vggtjax.clips.clip import read_clip
        from vggtjax.clips.sources import open_source
        from vggtjax.pipeline.windows import extend as extension
        from vggtjax.pipeline.windows.store import discard
        from vggtjax.results.folder import check_folder
        from vggtjax.results.reconstruction import Reconstruction

        with report.stage("read"):
            old = Reconstruction.load(result)
        check_folder(out, saving.names(tracks=old.track_frames is not None))
        options, fitter = extension.options_of(old), extension.fitter_of(old)
        source = list(clip) if watch else open_source(clip[0] if len(clip) == 1 else list(clip))
        model, fusion = files.load(report, options, [options.method])
        extension.check_result(model, old)

        def grown(old: Reconstruction, new: ClipSource, which: Sampling = Sampling()) -> Reconstruction:
            with report.stage("load clip") as progress:
                frames = read_clip(open_source(new), which, fitter, progress)
            given = {"extending": extending, "options": options, "fusion": fusion, "saving": saving}
            return extension.extend(model, old, frames, out=out, on_stage=report.stage, **given)

        if watch:
            both = _watched(Path(clip[0]), old, grown, fitter, extending.prefix, report)
            discard(out)
        else:
            both = grown(old, source, sampling)
    if both is old:
        report.line("No picture was added.")
    else:
        report.summary(both, out, model)


def _check_watch(clip: Sequence[str], sampling: Sampling) -> None:
    if len(clip) > 1 or not Path(clip[0]).is_dir():
        raise InputError(f"--watch is for one folder that fills with pictures, and {' '.join(clip)} is given")
    if sampling != Sampling():
        raise InputError("--watch takes every picture that comes; leave out --start, --stride, --fps and the like")


def _watched(
    folder: Path,
    result: Reconstruction,
    grown: Callable[[Reconstruction, ClipSource], Reconstruction],
    fitter: Fitter,
    prefix: str,
    report: Report,
) -> Reconstruction:
    """Add pictures to the result as they come into a folder, until Ctrl-C.

    A picture is whole when its file has not changed for three seconds. Pictures of another place wait for others.
    """
    from vggtjax.clips.media.order import in_order
    from vggtjax.pipeline.windows.growth import PlaceError

    def is_known(path: Path) -> bool:
        return prefix + path.stem in result.frame_names

    known = [path.name for path in _pictures(folder) if is_known(path)]
    note = f"; {len(known)} have names of known frames and are left out, such as {known[0]}" if known else ""
    report.note(f"waiting for pictures in {folder}{note}; Ctrl-C ends it")
    since: dict[Path, tuple[int, float]] = {}  # size of a file, and when it had it first
    broken: dict[Path, int] = {}  # size
    tried: set[Path] = set()
    try:
        while True:
            now = time.monotonic()
            sizes = {path: size for path, size in _pictures(folder).items() if not is_known(path)}
            since = {p: since[p] if p in since and since[p][0] == size else (size, now) for p, size in sizes.items()}
            whole = [p for p, (size, begun) in since.items() if now - begun >= _QUIET and broken.get(p) != size]
            for path in set(whole) - tried:
                if problem := _problem(path, fitter, result.images.shape[1:3]):
                    report.note(f"{path.name} is left out until it changes: {problem}")
                    broken[path] = sizes[path]
                    whole.remove(path)
            if set(whole) <= tried:
                time.sleep(_POLL)
                continue
            fitting = whole
            while fitting:
                try:
                    result = grown(result, [str(path) for path in in_order(fitting)])
                    report.note(f"the result has {len(result.frame_names)} frames")
                    break
                except PlaceError as error:
                    report.note(f"{len(error.frames)} of {len(fitting)} pictures wait for others: {error}")
                    fitting = [path for path in fitting if prefix + path.stem not in error.frames]
            tried = {path for path in whole if not is_known(path)}
    except KeyboardInterrupt:
        handled()
        return result


def _pictures(folder: Path) -> dict[Path, int]:
    """Return the pictures in a folder with the sizes of their files."""
    from vggtjax.clips.media.images import is_image_name

    found = {}
    for path in folder.iterdir():
        if is_image_name(path) and not path.name.startswith(".") and path.is_file():
            with suppress(OSError):  # it was moved away
                found[path] = path.stat().st_size
    return found


def _problem(path: Path, fitter: Fitter, size: tuple[int, ...]) -> str:
    """Return why a picture cannot be added: it cannot be read, or is fitted to another size; else an empty text."""
    from vggtjax.clips.media.images import read_image

    try:
        width, height = fitter.fit(*read_image(path).size, path.name).frame_size
    except InputError as error:
        return str(error)
    same = (height, width) == tuple(size)
    return "" if same else f"it is fitted to {width} x {height} pixels and the result has {size[1]} x {size[0]}"
