"""Many clips, each into a folder of its own; an interrupted batch resumes."""

from __future__ import annotations

import dataclasses
import json
from collections import deque
from collections.abc import Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip, read_clip
from vggtjax.clips.preprocessing import Fitter, Framing, FramingChanges
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, VggtjaxError
from vggtjax.known.given import check_readable
from vggtjax.known.intrinsics import known_values
from vggtjax.known.options import KnownGeometry
from vggtjax.method.fusion_family import FusionParams
from vggtjax.method.fusion_file import check_fuses, fusion_digest
from vggtjax.options import Options
from vggtjax.pipeline.contact import PAGE_NAME, ContactPage
from vggtjax.pipeline.devices import frames_mesh, whole_on
from vggtjax.pipeline.run import reconstruct
from vggtjax.pipeline.shards import parse_shard, running, starting
from vggtjax.progress import Progress, StageSeconds, no_progress
from vggtjax.refinement.refine import check_refinement
from vggtjax.results.archive import ARCHIVE_NAME, is_result
from vggtjax.results.disk import announce, forecast_bytes
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import RunFacts
from vggtjax.results.saving import Saving
from vggtjax.storage.json_values import read_json
from vggtjax.storage.writing import check_free, writing

SETTINGS_NAME = "batch.json"
_AHEAD = 1  # clips that are loaded before they are needed, and results that wait to be written


class ClipOutcome(NamedTuple):
    """The outcome of one clip of a batch."""

    name: str
    status: Literal["done", "kept", "failed"]  # kept: an earlier run has finished it
    reason: str = ""  # of a failure
    frames: int = 0


def reconstruct_many(
    model: Model,
    sources: Mapping[str, ClipSource],
    out: str | Path,
    *,
    options: Options | Mapping[str, Any] | None = None,
    framing: Framing | None = None,
    sampling: Sampling | Mapping[str, Any] | None = None,
    saving: Saving | Mapping[str, Any] | None = None,
    fusion: FusionParams | None = None,
    known: KnownGeometry | None = None,
    pad_frames: bool = False,
    shard: str | None = None,
    devices: int = 1,
    progress: Progress | None = None,
    **changes: Any,
) -> Generator[ClipOutcome]:
    """Reconstruct clips, each into a folder of its own, and yield the outcome of each as it is finished.

    Clips of one shape share compiled programs. A clip that fails, also for a name that is not a plain file name, does
    not stop the others. A later run with the same settings keeps finished clips, so an interrupted run resumes. A
    clip's folder appears whole or not at all. index.html shows the clips finished so far, and why others failed.

    Args:
        model: what `load_model` returned.
        sources: clips by name, as for `load_clip`; the names become folders.
        out: the folder of these folders.
        options: as for `reconstruct`; a mapping of the names in `changes`, of fusion and of pad_frames serves, too.
        fusion: as for `reconstruct`.
        known: as for `reconstruct`, as far as all clips share it: intrinsics, a shared focal length, the height of the
            cameras, and what "source" names.
        pad_frames: as for `reconstruct`.
        devices: as for `reconstruct`; the weights are copied once.
        framing: how frames are fitted; the keywords of `load_clip` serve, too.
        sampling: which frames are taken; the keywords of `load_clip` serve, too.
        saving: how results are written; the keywords of `Reconstruction.save` serve, too.
        shard: "K/N" takes every N-th of the sources, from the K-th on. Runs for K from 1 to N together do the batch, at
            the same time or not, in one folder; none of them writes index.html. A later run without `shard` does.
        progress: called before the first clip and after each computed clip, with the frames done and the frames of all
            clips but kept and failed ones; a clip of unknown length, such as a video, counts as the mean of the others.
        changes: fields of `framing` and `options` by name, such as `mode="pad"`.

    Raises:
        InputError: an invalid option, or a folder with results of other settings.
        OutputError: the folder cannot be written, or another run is writing it.
        TypeError: a name that is no option.
    """
    part = None if shard is None else parse_shard(shard)
    words: dict[str, Any] = dict(changes)
    if isinstance(options, Mapping):
        words, options = words | dict(options), None
        fusion, pad_frames = words.pop("fusion", fusion), words.pop("pad_frames", pad_frames)
    of_framing = {name: words.pop(name) for name in FramingChanges.__annotations__ if name in words}
    framing = dataclasses.replace(framing or Framing(), **of_framing)
    options = (options or Options()).changed(**words)
    check_fuses(fusion, options.method)
    if known is not None:
        known.check_many()
        check_readable(known)
    check_refinement(options.refine_cameras, known is not None and known.poses is not None)
    mesh = frames_mesh(devices)
    run = _Batch(
        model=model,
        placed=model if mesh is None else dataclasses.replace(model, params=whole_on(model.params, mesh)),
        options=options,
        fitter=framing.fitter(size=model.config.image_size, patch=model.config.patch_size),
        sampling=Sampling(**sampling) if isinstance(sampling, Mapping) else sampling or Sampling(),
        saving=Saving().changed(**saving) if isinstance(saving, Mapping) else saving or Saving(),
        fusion=fusion,
        known=known or None,
        pad_frames=pad_frames,
        devices=devices,
    )
    out, progress = Path(out), progress or no_progress
    with ExitStack() as whole:
        whole.enter_context(starting(out, part))
        check_free(out, (PAGE_NAME,), replaced=(out / SETTINGS_NAME).is_file(), what="batch")
        _settle(out, run.settings)
        with running(out, part):
            if part is not None:
                whole.close()  # for the other shards
                yield from _outcomes(run, part.share(sources), out, progress)
                return
            page = ContactPage(out, len(sources))
            for outcome in _outcomes(run, sources, out, progress):
                page.add(outcome.name, outcome.reason if outcome.status == "failed" else None)
                yield outcome


@dataclass(frozen=True)
class _Batch:
    """What all clips of a batch have in common."""

    model: Model
    placed: Model  # the same, with its weights on every device
    options: Options
    fitter: Fitter
    sampling: Sampling
    saving: Saving
    fusion: FusionParams | None
    known: KnownGeometry | None
    pad_frames: bool
    devices: int

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the results, as JSON values."""
        return {
            "model": self.model.identity.to_json(),
            "mode": self.fitter.mode,
            "size": self.fitter.size,
            **dataclasses.asdict(self.sampling),
            "stride": self.sampling.step,
            **self.options.resolved().to_json(),
            **dataclasses.asdict(self.saving),
            "only": None if self.saving.only is None else list(self.saving.only),
            "fusion": fusion_digest(self.fusion),
            **({} if self.known is None else {"known": known_values(self.known)}),
            "pad_frames": self.pad_frames,
        }

    def load(self, source: ClipSource) -> Clip:
        return read_clip(open_source(source), self.sampling, self.fitter)

    def reconstruct(self, clip: Clip, seconds: StageSeconds) -> Reconstruction:
        size = self.fitter.size
        return reconstruct(
            self.placed,
            clip,
            options=self.options,
            size=size,
            fusion=self.fusion,
            known=self.known,
            pad_frames=self.pad_frames,
            devices=self.devices,
            on_stage=seconds.stage,
        )

    def write(
        self, name: str, clip: Clip, result: Reconstruction, folder: Path, seconds: Mapping[str, float]
    ) -> ClipOutcome:
        pictures = clip.pictures() if self.saving.resolution == "original" else None
        # A new folder appears whole or not at all.
        with nullcontext(folder) if folder.exists() else writing(folder) as place:
            result.save(place, saving=self.saving, pictures=pictures, facts=RunFacts(seconds))
        return ClipOutcome(name, "done", frames=len(clip))


def _outcomes(run: _Batch, sources: Mapping[str, ClipSource], out: Path, progress: Progress) -> Generator[ClipOutcome]:
    """Yield the outcomes of clips that cannot have a folder, then of kept ones, then of the others."""
    taken = {"", "..", SETTINGS_NAME, PAGE_NAME}
    odd = {name for name in sources if name in taken or Path(name).name != name or not name.isprintable()}
    reason = "a clip is named {!r}; expected a plain name, which becomes its folder"
    yield from (ClipOutcome(name, "failed", reason.format(name)) for name in sources if name in odd)
    kept = {name for name in sources if name not in odd and is_result(out / name / ARCHIVE_NAME)}
    yield from (ClipOutcome(name, "kept") for name in sources if name in kept)
    names = [name for name in sources if name not in odd and name not in kept]
    work = _Work({name: _length(sources[name], run.sampling) for name in names}, progress)
    yield from _reconstruct_all(run, {name: sources[name] for name in names}, out, work)


def _reconstruct_all(run: _Batch, sources: Mapping[str, ClipSource], out: Path, work: _Work) -> Generator[ClipOutcome]:
    """Yield the outcomes of clips: while one is computed, the next is loaded and the previous one written."""
    with ThreadPoolExecutor(1) as loader, ThreadPoolExecutor(1) as writer:
        loading: deque[tuple[str, Future[Clip]]] = deque()
        writes: deque[tuple[str, Future[ClipOutcome]]] = deque()
        waiting = iter(sources)

        def fill() -> None:
            while len(loading) <= _AHEAD and (name := next(waiting, None)) is not None:
                loading.append((name, loader.submit(run.load, sources[name])))

        try:
            fill()
            while loading:
                name, loaded = loading.popleft()
                fill()
                try:
                    clip = loaded.result()
                    announce(out / name, forecast_bytes(clip.images.shape[:3], clip.source_size, run.saving))
                    result = run.reconstruct(clip, seconds := StageSeconds())
                except (VggtjaxError, MemoryError) as error:
                    work.finish(name, 0)
                    yield _failed(name, error)
                    continue
                work.finish(name, len(clip))
                writes.append((name, writer.submit(run.write, name, clip, result, out / name, seconds.seconds)))
                del clip, result  # the writer holds them
                while len(writes) > _AHEAD:
                    yield _written(*writes.popleft())
            while writes:
                yield _written(*writes.popleft())
        except BaseException:
            for pool in (loader, writer):
                pool.shutdown(cancel_futures=True)
            raise


def _failed(name: str, error: BaseException) -> ClipOutcome:
    return ClipOutcome(name, "failed", str(error) or "out of memory")


class _Work:
    """Frames done and to do; a clip of unknown length counts as the mean of the others, or as 1 if none is known."""

    def __init__(self, lengths: Mapping[str, int | None], progress: Progress) -> None:
        self._waiting = dict(lengths)
        self._done: list[int] = []
        self._progress = progress
        self._tell()

    def finish(self, name: str, frames: int) -> None:
        """Count a clip as done; a failed clip has 0 frames."""
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
    """Return the number of frames of a clip: 0 if the clip will fail, None if only reading it can tell."""
    try:
        return open_source(source).total(sampling)
    except VggtjaxError:
        return 0


def _written(name: str, write: Future[ClipOutcome]) -> ClipOutcome:
    try:
        return write.result()
    except (VggtjaxError, MemoryError) as error:
        return _failed(name, error)


def _settle(out: Path, settings: dict[str, Any]) -> None:
    """Write the settings of a batch into its folder. Raises InputError if the folder has other settings."""
    path = out / SETTINGS_NAME
    if not path.is_file():
        with writing(path) as temporary:
            temporary.write_text(json.dumps(settings, indent=2, sort_keys=True) + "\n", encoding="utf-8")
        return
    earlier = read_json(path, dict[str, Any], "settings of a batch")
    names = [name for name in settings | earlier if earlier.get(name) != settings.get(name)]
    if names:
        others = "; ".join(f"{name} {earlier.get(name)!r}, now {settings.get(name)!r}" for name in names)
        raise InputError(
            f"{path} has other settings than this run ({others}); choose another folder, or move the file away"
        )
