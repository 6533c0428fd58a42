"""Many clips, one after the other: while one is computed the next is loaded and the one before is written."""

from __future__ import annotations

import json
import os
import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip, load_clip
from vggtjax.clips.preprocessing import Layout, Mode
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, OutputError, VggtjaxError
from vggtjax.method.fusion_file import fusion_digest
from vggtjax.options import find_method
from vggtjax.pipeline.run import reconstruct
from vggtjax.results.archive import ARCHIVE_NAME, is_result
from vggtjax.storage.writing import writing

SETTINGS_NAME = "batch.json"
_AHEAD = 1  # clips that are loaded before they are needed, and results that wait to be written


class Outcome(NamedTuple):
    """What became of a clip."""

    name: str
    status: Literal["done", "kept", "failed"]  # kept: an earlier run has finished it
    reason: str = ""  # of a failure
    frames: int = 0


def reconstruct_many(
    model: Model,
    sources: Mapping[str, ClipSource],
    out: str | Path,
    *,
    mode: Mode = "crop",
    size: int | None = None,
    sampling: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
    saving: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Generator[Outcome]:
    """Reconstruct clips, each into a folder of its own, and yield what became of each as it is finished.

    Clips of one shape share a compilation. A clip that fails does not stop the others. Run again with the same
    settings, and what is finished is kept: an interrupted run goes on. A clip's folder appears whole or not at all.

    Args:
        model: what `load_model` returned.
        sources: clips by name, as for `load_clip`; the names become folders.
        out: folder for theirs.
        mode, size: as for `load_clip`; the model's own size if None.
        sampling: `fps`, `stride`, `start`, `max_frames` of `load_clip`.
        options: keywords of `reconstruct`, such as `method`.
        saving: keywords of `Reconstruction.save`, but for pictures, which are the clips' own where it wants them.
        progress: called before the first clip and after each is computed, with the frames done and the frames of all
            clips but those kept or failed; a clip whose length only reading tells, such as a video, counts until then
            as the mean of the others.

    Raises:
        InputError: names that are no plain file names, a size, sampling or method that is none, or a folder with
            results of other settings.
        OutputError: the folder cannot be written.
    """
    out = Path(out)
    for name in sources:
        if name in ("", ".", "..") or Path(name).name != name or not name.isprintable():
            raise InputError(f"a clip is named {name!r}; expected a plain name, that of its folder")
    size = model.config.image_size if size is None else size
    Layout(mode, size, model.config.patch_size)  # what is wrong for all clips is said once, and before any
    sampling, options, saving = dict(sampling or {}), dict(options or {}), dict(saving or {})
    frames_taken = Sampling(**sampling)
    find_method(options.get("method", "4dvggt-d"))
    settings = {"model": model.name, "mode": mode, "size": size, **sampling, **options, **saving}
    if options.get("fusion") is not None:
        settings["fusion"] = fusion_digest(options["fusion"])
    _settle(out, settings)

    def load(name: str) -> Clip:
        return load_clip(sources[name], mode=mode, size=size, patch=model.config.patch_size, **sampling)

    def write(name: str, clip: Clip, result: Any) -> Outcome:
        pictures = clip.pictures() if saving.get("resolution") == "original" else None
        with _arriving(out / name) as folder:
            result.save(folder, pictures=pictures, **saving)
        return Outcome(name, "done", frames=len(clip))

    kept = {name for name in sources if is_result(out / name / ARCHIVE_NAME)}
    names = [name for name in sources if name not in kept]
    yield from (Outcome(name, "kept") for name in sources if name in kept)
    work = None if progress is None else _Work({name: _length(sources[name], frames_taken) for name in names}, progress)
    with ThreadPoolExecutor(1) as loader, ThreadPoolExecutor(1) as writer:
        loading: deque[tuple[str, Future[Clip]]] = deque()
        writes: deque[tuple[str, Future[Outcome]]] = deque()
        waiting = iter(names)

        def fill() -> None:
            while len(loading) <= _AHEAD and (name := next(waiting, None)) is not None:
                loading.append((name, loader.submit(load, name)))

        try:
            fill()
            while loading:
                name, loaded = loading.popleft()
                fill()
                try:
                    clip = loaded.result()
                    result = reconstruct(model, clip, size=size, **options)
                except (VggtjaxError, MemoryError) as error:
                    if work is not None:
                        work.finish(name, 0)
                    yield Outcome(name, "failed", str(error) or "out of memory")
                    continue
                if work is not None:
                    work.finish(name, len(clip))
                writes.append((name, writer.submit(write, name, clip, result)))
                del clip, result  # the writer has them
                while len(writes) > _AHEAD:
                    yield _written(*writes.popleft())
            while writes:
                yield _written(*writes.popleft())
        except BaseException:
            for pool in (loader, writer):
                pool.shutdown(cancel_futures=True)
            raise


class _Work:
    """Frames done and to do; a clip of unknown length counts as the mean of the others, or 1 where none is known."""

    def __init__(self, lengths: Mapping[str, int | None], progress: Callable[[int, int], object]) -> None:
        self._waiting = dict(lengths)
        self._done: list[int] = []
        self._progress = progress
        self._tell()

    def finish(self, name: str, frames: int) -> None:
        """A clip is computed, or has failed with 0 frames."""
        del self._waiting[name]
        if frames:
            self._done.append(frames)
        self._tell()

    def _tell(self) -> None:
        lengths = self._done + [length for length in self._waiting.values() if length]
        unknown = sum(length is None for length in self._waiting.values())
        mean = sum(lengths) / len(lengths) if lengths else 1
        self._progress(sum(self._done), sum(lengths) + round(unknown * mean))


def _length(source: ClipSource, sampling: Sampling) -> int | None:
    """Return how many frames a clip has: 0 where it will fail, None where only reading tells."""
    try:
        return open_source(source).total(sampling)
    except VggtjaxError:
        return 0


@contextmanager
def _arriving(folder: Path) -> Iterator[Path]:
    """Yield a new folder that becomes `folder` by one rename at the end; `folder` itself where that is there already.

    What a killed run has left of the new folder goes first. Raises OutputError where it cannot be renamed.
    """
    if os.path.lexists(folder):
        yield folder
        return
    part = folder.with_name(f".{folder.name}.partial")
    try:
        shutil.rmtree(part, ignore_errors=True)
        yield part
        try:
            part.rename(folder)
        except OSError as error:
            raise OutputError(f"cannot write {folder}: {error.strerror}; is another run writing it?") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _written(name: str, write: Future[Outcome]) -> Outcome:
    try:
        return write.result()
    except (VggtjaxError, MemoryError) as error:
        return Outcome(name, "failed", str(error) or "out of memory")


def _settle(out: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings of a batch into its folder, or make sure that those there are the same."""
    text = json.dumps(settings, indent=2, sort_keys=True, default=str) + "\n"
    path = out / SETTINGS_NAME
    if path.is_file():
        if path.read_text(encoding="utf-8") != text:
            raise InputError(f"{path} has other settings than this run; choose another folder, or move it away")
        return
    with writing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
