"""A long clip and a model -> a result on disk, window by window: memory does not depend on the clip's length.

Consistent depth is the exception: it fits the joined clip, of up to 512 frames, as a whole.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float32, UInt8

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.clip import Clip
from vggtjax.clips.fingerprint import source_setting
from vggtjax.clips.masks import load_masks, masks_digest
from vggtjax.clips.media.sampling import Sampling, Source
from vggtjax.clips.preprocessing import Fitter, Framing
from vggtjax.clips.queries import Queries, check_queries, check_words, parse_queries
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError
from vggtjax.method.algorithm import compute_by
from vggtjax.method.assembly import check_fuses
from vggtjax.method.fusion.family import FusionParams
from vggtjax.method.fusion.file import check_kept, fusion_digest
from vggtjax.method.passes import track_from
from vggtjax.network.backbone import ClipBatch, Features, encode
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.track_head import check_track_size
from vggtjax.options import Options
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.inputs import check_tracks
from vggtjax.pipeline.run import reconstruct
from vggtjax.pipeline.running import Running
from vggtjax.pipeline.steps import Execute
from vggtjax.pipeline.windows.frames import SeenFrames, count_frames, window_clips
from vggtjax.pipeline.windows.overlap import thinned
from vggtjax.pipeline.windows.plan import Windows, plan_windows
from vggtjax.pipeline.windows.store import FOLDER, WindowStore, write_cut
from vggtjax.pipeline.windows.tracks import Follow, Images, Tracked, TrackStart
from vggtjax.pipeline.windows.whole import Whole, store_window
from vggtjax.progress import OnStage, StageSeconds, no_progress, no_stage
from vggtjax.results.disk import announce, forecast_bytes
from vggtjax.results.folder import check_folder
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import RunFacts, versions
from vggtjax.results.result import without_mask
from vggtjax.results.saving import Saving
from vggtjax.storage.interruption import kept
from vggtjax.storage.writing import locked_folder

logger = logging.getLogger(__name__)

_JOINED = 12.0 + 12.0  # bytes of a pixel, beside the files of a result: blended arrays, windows


class Tools(NamedTuple):
    """What is done with a window's frames."""

    run: Callable[[Clip], Reconstruction]
    describe: Callable[[Float32[np.ndarray, "F H W 3"]], Float32[np.ndarray, "F C"]]  # features for finding loops
    patches: Callable[[Float32[np.ndarray, "F H W 3"]], tuple[Float32[np.ndarray, "F N C"], int]]  # by `thinned`
    follow: Follow | None = None
    check_track_size: Callable[[int, int], None] = lambda height, width: None  # raises InputError for small frames


class LongRun(NamedTuple):
    """How a long clip is read, joined and written."""

    frames: int | None = None  # of the clip, where it is known; else they are counted
    sampling: Sampling = Sampling()
    fitter: Fitter = Fitter()
    saving: Saving = Saving()
    tracks: Queries | str | None = None  # points to follow: in pixels of the fitted frames, or words for parse_queries
    on_stage: OnStage = no_stage


def reconstruct_long(
    model: Model,
    source: ClipSource,
    out: str | Path,
    windows: Windows,
    *,
    options: Options = Options(),
    long_run: LongRun | None = None,
    fusion: FusionParams | None = None,
    masks: str | Path | Literal[False] | None = None,
    **changes: Any,
) -> Reconstruction:
    """Reconstruct a clip in windows, which are joined, and write the result: memory does not depend on the length.

    Consistent depth is the exception: it fits the joined clip, of up to 512 frames, as a whole.

    Each window is run by `reconstruct`. What is done is kept in a folder inside `out`, so that the same call goes on
    where a killed run stopped; the folder is removed at the end.

    Args:
        model: what `load_model` returned.
        source: as for `load_clip`; at least one frame more than a window.
        out: the folder of the result, as for `Reconstruction.save`.
        windows: how the clip is cut.
        options: as for `reconstruct`.
        long_run: how the clip is read and written; by default at the model's size.
        fusion: as for `reconstruct`.
        masks: folder of pictures of what moves, named like the frames; False: nothing moves; None: mined.
        changes: fields of `options` by name.

    Returns:
        The result, opened lazily from `out`.

    Raises:
        InputError: an invalid option, or a clip that is not longer than a window.
        ClipError: a source that cannot be read, that changes, or whose frames have several sizes.
        OutputError: the folder cannot be written, or another run is writing it.
        DeviceMemoryError: a window does not fit in the memory of the device.
    """
    asked = options.changed(**changes)
    consistent = asked.consistent_depth
    if masks is not None:
        asked.check_given_masks()
    options = asked.resolved(model.config.motion)
    check_fuses(fusion, options.method)
    check_kept(fusion)
    plan = long_run or LongRun(fitter=Framing().fitter(model.config))
    if isinstance(plan.tracks, str):
        check_words(plan.tracks)
    if plan.tracks is not None:
        check_tracks(model)
    if options.refine_cameras:
        raise InputError("refine_cameras is for clips that are run at once; leave it out, or take fewer frames")
    options, asked = (each.changed(consistent_depth=False) for each in (options, asked))
    tools = tools_of(model, asked, plan.fitter.size, fusion=fusion, masks=masks)
    settings = {
        "model": model.identity.to_json(),
        "options": options.to_json(),
        "fusion": fusion_digest(fusion),
        "masks": masks_digest(masks),
        "versions": versions(),
    }
    return run_windows(source, Path(out), windows, plan, tools, settings, consistent=consistent)


def tools_of(
    model: Model,
    options: Options = Options(),
    size: int | None = None,
    *,
    fusion: FusionParams | None = None,
    masks: str | Path | Literal[False] | None = None,
    pad_frames: bool = False,
) -> Tools:
    """Return what runs a window by `reconstruct`, and describes frames by the means of their patch tokens."""
    config = model.config

    def run(clip: Clip) -> Reconstruction:
        moving = load_masks(str(masks), clip) if isinstance(masks, str | Path) else masks
        running = Running(is_part=True, pad_frames=pad_frames)
        return reconstruct(model, clip, options=options, running=running, size=size, masks=moving, fusion=fusion)

    execute, compute = Execute(), compute_by(options)

    def features(images: Array) -> Features:
        return execute("image features", encode)(
            model.params, images, config=config, compute_dtype=compute.compute_dtype, remat=compute.remat
        )

    def tokens(images: Float32[np.ndarray, "F H W 3"]) -> Float32[np.ndarray, "F P C"]:
        return np.asarray(features(jax.device_put(images[None])).patch_tokens[0], np.float32)

    def describe(images: Float32[np.ndarray, "F H W 3"]) -> Float32[np.ndarray, "F C"]:
        return tokens(images).mean(axis=1)

    def patches(images: Float32[np.ndarray, "F H W 3"]) -> tuple[Float32[np.ndarray, "F N C"], int]:
        height, width = (side // config.patch_size for side in images.shape[1:3])
        return thinned(tokens(images), (height, width))

    def follow(images: Images, starts: Sequence[TrackStart]) -> list[Tracked]:
        frames = jax.device_put(images[None])
        clips, found = ClipBatch(frames, features(frames)), []
        for frame, places in starts:
            points = jax.device_put(places[None])
            track = execute("tracks", track_from)
            tracks = track(model.params, clips, points, np.asarray(frame, np.int32), config=config, compute=compute)
            found.append(Tracked(*(np.asarray(value)[0] for value in tracks)))
        return found

    return Tools(run, describe, patches, follow, partial(check_track_size, config=config))


def run_windows(
    source: ClipSource,
    out: Path,
    windows: Windows,
    plan: LongRun,
    tools: Tools,
    settings: dict[str, Any],
    *,
    consistent: bool = False,
) -> Reconstruction:
    """Run, join and write the windows of a clip; `reconstruct_long` says more.

    Args:
        source: of the frames.
        out: the folder of the result.
        windows: how the clip is cut.
        plan: how the clip is read, joined and written.
        tools: what runs and describes the frames of a window.
        settings: all else that decides the windows, as JSON values; stored windows of other settings are not used.
        consistent: make the depth of the joined clip consistent, by its pixels alone.
    """
    opened, seconds = open_source(source), StageSeconds()
    stage = seconds.telling(plan.on_stage)
    check_folder(out, plan.saving.names(tracks=plan.tracks is not None))
    frames = count_frames(opened, plan.sampling) if plan.frames is None else plan.frames
    if not windows.cuts(frames):
        raise InputError(f"the clip has {frames} frames and window is {windows.window}; expected a longer clip")
    assert windows.window is not None
    cut = plan_windows(frames, windows.window, windows.shared)
    known = source_setting(opened)
    decides = settings | known | _choices(opened, plan, frames, windows)
    clips = window_clips(opened, plan.sampling, plan.fitter, cut)
    first = next(clips)  # what is wrong with it is found before anything is written
    _check_first(first, frames, plan, tools)
    shape = (frames, *first.images.shape[1:3])
    sizes = np.repeat(first.source_size[:1], frames, axis=0)
    announce(out, forecast_bytes(shape, sizes, plan.saving) + _JOINED * np.prod(shape))
    with locked_folder(out / FOLDER, "the windows of a clip"):
        store = WindowStore(out, decides)
        write_cut(out, windows.window, windows.shared)
        whole = Whole(store, cut, tools.run, plan.on_stage)
        clip, seen = first, SeenFrames()
        if before := store.count():
            logger.info("%d of %d windows are kept from a run that was stopped", before, len(cut))

        def stopped() -> str:
            return f"{store.count()} of {len(cut)} windows are kept; run the same command again to resume"

        with kept(stopped), stage("windows") as progress:
            for number, clip in enumerate(chain([first], clips)):
                seen.add(clip, cut[number])
                store_window(number, clip, cut[number], store, tools.run, tools.describe)
                (progress or no_progress)(number + 1, len(cut))
        tracks = {}
        if plan.tracks is not None:
            assert tools.follow is not None
            queries = parse_queries(plan.tracks, seen.clip()) if isinstance(plan.tracks, str) else plan.tracks
            with stage("follow points") as progress:
                tracks = whole.tracks(queries, tools.follow, progress)
        with kept(stopped), seconds.stage("join and blend"):
            result = whole.result(clip, loops=not windows.no_loops, tracks=tracks)

        def pictures() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
            return (np.asarray(frame.image) for frame in opened.frames(plan.sampling))

        result = agree_with_pixels(result, pictures, Options(consistent_depth=consistent), on_stage=stage)
        result = without_mask(result)
        result = dataclasses.replace(result, settings=result.settings | known)
        with plan.on_stage("write") as progress:
            shown = pictures() if plan.saving.resolution == "original" else None
            facts = RunFacts(seconds.seconds)
            result.save(out, saving=plan.saving, pictures=shown, progress=progress, facts=facts)
        del result
        store.remove()
    return Reconstruction.load(out)


def _choices(opened: Source, plan: LongRun, frames: int, windows: Windows) -> dict[str, Any]:
    """Return what decides the frames of the windows, as JSON values."""
    undone = isinstance(opened, CaptureFrames) and opened.lenses_undone
    return {
        "sampling": dataclasses.asdict(plan.sampling),
        "fitter": dataclasses.asdict(plan.fitter),
        "windows": [frames, windows.window, windows.shared],
        **({"undistorted": undone} if undone else {}),
    }


def _check_first(first: Clip, frames: int, plan: LongRun, tools: Tools) -> None:
    """Raise InputError where the points to follow do not fit the clip, of which this is the first window."""
    if plan.tracks is None:
        return
    height, width = first.images.shape[1:3]
    tools.check_track_size(height, width)
    if isinstance(plan.tracks, str):
        check_queries(plan.tracks, first, frames)
    else:
        plan.tracks.check(frames, height, width)
