"""Many clips, each into a folder of its own; an interrupted batch resumes."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from vggtjax.clips.clip import Clip
from vggtjax.clips.fetched import Fetched
from vggtjax.clips.sources import ClipSource
from vggtjax.errors import VggtjaxError
from vggtjax.method.assembly import check_fuses
from vggtjax.method.fusion.family import FusionParams
from vggtjax.method.fusion.file import check_kept
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.batch.clip_work import ClipWork, LongClip
from vggtjax.pipeline.batch.contact import contact_page
from vggtjax.pipeline.batch.destination import Destination, destination, has_changed
from vggtjax.pipeline.batch.recipe import BatchRecipe, ClipOutcome, counted, failed, invalid_name
from vggtjax.pipeline.batch.shards import parse_shard
from vggtjax.progress import Progress, StageSeconds, no_progress

_AHEAD = 1  # clips that are loaded before they are needed, and results that wait to be written


def reconstruct_many(
    model: Model,
    sources: Mapping[str, ClipSource],
    out: str | Path,
    *,
    recipe: BatchRecipe = BatchRecipe(),
    fusion: FusionParams | None = None,
    shard: str | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> Generator[ClipOutcome]:
    """Reconstruct clips, each into a folder of its own, and yield the outcome of each as it is finished.

    Clips of one shape share compiled programs. A clip that fails, also for a name that is not a plain file name, does
    not stop the others. A later run with the same settings keeps finished clips, so an interrupted run resumes; it does
    those again whose arrays, or files by their names, sizes, first and last bytes, have changed; of a capture the
    pictures alone count. A clip's folder appears whole or not at all. A clip that does not fit in memory is run in
    windows, as by `reconstruct_long`, unless an option needs all frames at once; it then fails before it is read.
    index.html shows the clips finished so far, and why others failed.

    Args:
        model: what `load_model` returned.
        sources: clips by name, as for `load_clip`, or URLs; the names become folders.
        out: the folder of these folders, or a URL such as "s3://bucket/results".
        recipe: how all clips are read, reconstructed and written; `changes` says its parts.
        fusion: as for `reconstruct`.
        shard: "K/N" takes every N-th of the sources, from the K-th on. Runs for K from 1 to N together do the batch, at
            the same time or not, in one folder; none of them writes index.html. A later run without `shard` does.
        progress: called before the first clip and after each, with the number of computed clips, and of all but kept
            and failed ones.
        changes: parts of the recipe by name, or what they hold: `options` (`method="vggt"`, ...), `framing` (`size`,
            `mode`), `sampling` (`fps`, `stride`, ...) and `saving` (`only`, `resolution`, ...);
            `known`, as for `reconstruct`, as far as all clips share it: intrinsics, a shared focal length, the height
            of the cameras, and what "source" names; `devices`, as for `reconstruct`, where the weights are copied once;
            `pad_frames`, as for `reconstruct`; `unchecked`: do not compare the memory that a clip needs with what is
            free; `masks`: what moves in each clip, by its name: an array or a folder of pictures as for `reconstruct`,
            or False for nothing; or a folder of such folders, named like the clips. Masks of other clips are mined.
            False: nothing moves in any clip. Options of mined masks are then refused. A later run with other masks is
            refused, too.

    Raises:
        InputError: an invalid option, or a folder with results of other settings.
        OutputError: the folder cannot be written, or another run is writing it.
        TypeError: a name that is no option.
    """
    part = None if shard is None else parse_shard(shard)
    recipe = recipe.changed(**changes)
    check_fuses(fusion, recipe.options.method)
    check_kept(fusion)
    recipe.check(sources)
    place = destination(out)
    work = ClipWork(model, fusion, recipe, place)
    progress = progress or no_progress
    with place.held(part, work.settings):
        if part is not None:
            yield from _outcomes(work, part.share(sources), place, progress)
            return
        with contact_page(place, len(sources)) as tell:
            for outcome in _outcomes(work, sources, place, progress):
                tell(outcome)
                yield outcome


def _outcomes(
    work: ClipWork, sources: Mapping[str, ClipSource], place: Destination, progress: Progress
) -> Generator[ClipOutcome]:
    """Yield the outcomes of clips that cannot have a folder, then of kept ones, then of the others."""
    odd = {name: outcome for name in sources if (outcome := invalid_name(name)) is not None}
    yield from odd.values()
    there, left = place.finished(name for name in sources if name not in odd), dict[str, ClipSource]()
    for name in sources:
        if name in there and not has_changed(place, name, sources[name]):
            yield ClipOutcome(name, "kept")
        elif name not in odd:
            left[name] = sources[name]
    for outcome in counted(_reconstruct_all(work, left), len(left), progress):
        yield outcome.of_changed() if outcome.name in there else outcome


def _reconstruct_all(work: ClipWork, sources: Mapping[str, ClipSource]) -> Generator[ClipOutcome]:
    """Yield the outcomes of clips: while one is computed, the next is loaded and the previous one written."""
    with Fetched() as fetched, ThreadPoolExecutor(1) as loader, ThreadPoolExecutor(1) as writer:
        loading: deque[tuple[str, Future[tuple[ClipSource, Clip | LongClip]]]] = deque()
        writes: deque[tuple[str, Future[ClipOutcome]]] = deque()
        waiting = iter(sources)

        def load(name: str) -> tuple[ClipSource, Clip | LongClip]:
            source = fetched.local(name, sources[name])
            return source, work.long_clip(source, clips=1 + 2 * _AHEAD) or work.load(source)

        def fill() -> None:
            while len(loading) <= _AHEAD and (name := next(waiting, None)) is not None:
                loading.append((name, loader.submit(load, name)))

        def written() -> ClipOutcome:
            name, write = writes.popleft()
            try:
                return write.result()
            except (VggtjaxError, MemoryError) as error:
                return failed(name, error)
            finally:
                fetched.drop(name)

        try:
            fill()
            while loading:
                name, loaded = loading.popleft()
                fill()
                try:
                    source, clip = loaded.result()
                    seconds = StageSeconds()
                    del loaded  # it holds the clip
                    result = clip if isinstance(clip, LongClip) else work.reconstruct_or_cut(name, clip, seconds)
                    if isinstance(result, LongClip):
                        del clip
                        finish = partial(_same, work.run_long(name, source, result))
                    else:
                        assert isinstance(clip, Clip)
                        finish = partial(work.write, name, clip, result, seconds.seconds)
                        del clip
                    del result
                except (VggtjaxError, MemoryError) as error:
                    finish = partial(_same, failed(name, error))
                writes.append((name, writer.submit(finish)))
                del finish  # the writer holds clip and result
                while len(writes) > _AHEAD:
                    yield written()
            while writes:
                yield written()
        except BaseException:
            for pool in (loader, writer):
                pool.shutdown(cancel_futures=True)
            raise


def _same(outcome: ClipOutcome) -> ClipOutcome:
    return outcome
