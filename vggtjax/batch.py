"""Many clips, one after the other: while one is computed the next is loaded and the one before is written."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip, load_clip
from vggtjax.clips.preprocessing import Layout, Mode
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import ClipSource
from vggtjax.errors import InputError, VggtjaxError
from vggtjax.files import writing
from vggtjax.methods import find_method
from vggtjax.pipeline import reconstruct
from vggtjax.results.reconstruction import ARCHIVE_NAME, is_result

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
) -> Generator[Outcome]:
    """Reconstruct clips, each into a folder of its own, and yield what became of each as it is finished.

    Clips of one shape share a compilation. A clip that fails does not stop the others. Run again with the same
    settings, and what is finished is kept: an interrupted run goes on.

    Args:
        model: what `load_model` returned.
        sources: clips by name, as for `load_clip`; the names become folders.
        out: folder for theirs.
        mode, size: as for `load_clip`; the model's own size if None.
        sampling: `fps`, `stride`, `start`, `max_frames` of `load_clip`.
        options: keywords of `reconstruct`, such as `method`.
        saving: keywords of `Reconstruction.save`, but for pictures, which are the clips' own where it wants them.

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
    Sampling(**sampling)
    find_method(options.get("method", "4dvggt-d"))
    _settle(out, {"model": model.name, "mode": mode, "size": size, **sampling, **options, **saving})

    def load(name: str) -> Clip:
        return load_clip(sources[name], mode=mode, size=size, patch=model.config.patch_size, **sampling)

    def write(name: str, clip: Clip, result: Any) -> Outcome:
        pictures = clip.pictures() if saving.get("resolution") == "original" else None
        result.save(out / name, pictures=pictures, **saving)
        return Outcome(name, "done", frames=len(clip))

    names = [name for name in sources if not is_result(out / name / ARCHIVE_NAME)]
    yield from (Outcome(name, "kept") for name in sources if name not in names)
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
                    yield Outcome(name, "failed", str(error) or "out of memory")
                    continue
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
