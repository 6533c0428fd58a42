"""A finished result and new frames of its place -> a result of both, in the frame and scale of the old one.

    features of patches -> anchors: frames of the result that show the place of the new ones, spread over its path
    windows of anchors and new frames, run by the method as it is
    each window is joined to the result, and to other windows, by the depth, confidence and cameras of its anchors
    all joins are solved together

The old frames stay as they are, bit by bit.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from vggtjax.clips.clip import Clip, read_clip
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, one_line
from vggtjax.method.fusion.family import FusionParams
from vggtjax.method.fusion.file import fusion_digest
from vggtjax.network.checkpoint import Model
from vggtjax.options import METHODS, Options
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.running import check_kinds
from vggtjax.pipeline.windows.growth import Growth, PlaceError
from vggtjax.pipeline.windows.plan import Extending
from vggtjax.pipeline.windows.run import Tools, tools_of
from vggtjax.pipeline.windows.store import FOLDER, WindowStore
from vggtjax.pipeline.windows.whole import window_name
from vggtjax.progress import OnStage, Progress, StageSeconds, no_progress, no_stage
from vggtjax.results.disk import announce, forecast_bytes
from vggtjax.results.folder import check_folder
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import RunFacts, versions
from vggtjax.results.result import missing_fields, without_mask
from vggtjax.results.saving import Saving
from vggtjax.storage.interruption import kept
from vggtjax.storage.writing import locked_folder, write_errors


def extend(
    model: Model,
    result: Reconstruction,
    clip: Clip | ClipSource,
    *,
    out: str | Path | None = None,
    extending: Extending = Extending(),
    options: Options | None = None,
    fusion: FusionParams | None = None,
    saving: Saving = Saving(),
    on_stage: OnStage = no_stage,
) -> Reconstruction:
    """Return a result with the frames of `result`, bit by bit, and behind them those of a clip of the same place.

    The new frames are in the frame and the scale of the old ones; points that were tracked are not followed in them.
    `settings["extended"]` says of each extension where its frames are from, and how well the anchors agree.

    Args:
        model: the one that made the result.
        result: of one clip, of windows, or itself extended.
        clip: the new frames, fitted as those of the result: what `load_clip` returned, or what it takes.
        out: folder that the new result is written to. Windows that are done are kept in it until then, so that the same
            call goes on where a killed run stopped. None: nothing is written.
        extending: how the new frames are run and joined.
        options: as for `reconstruct`, of the result's method; by default those of the result. `refine_cameras` is not
            done.
        fusion: as for `reconstruct`; the rule that fused the result.
        saving: how the result is written.
        on_stage: as for `reconstruct`.

    Raises:
        InputError: a result of another model or rule of fusion, or without stored pictures; frames of another size or
            with equal names.
        PlaceError: new frames that show another place, or anchors on which everything moves or that do not agree.
        ClipError: a source that cannot be read.
        OutputError: `out` cannot be written, or another run is writing it.
        DeviceMemoryError: a window does not fit in the memory of the device.
    """
    check_kinds(model=model)
    check_result(model, result)
    options = options_of(result) if options is None else options
    check_kinds(options=options)
    options = options.changed(refine_cameras=False)
    _check_method(result, options, fusion)
    seconds = StageSeconds()
    stage = seconds.telling(on_stage)
    if out is not None:
        check_folder(Path(out), saving.names(tracks=result.track_frames is not None))
    if not isinstance(clip, Clip):
        with stage("load clip") as progress:
            clip = read_clip(open_source(clip), Sampling(), fitter_of(result), progress)
    names = [extending.prefix + name for name in clip.frame_names]
    _check_clip(result, clip, names)
    tools = tools_of(model, options.changed(consistent_depth=False), clip.size, fusion=fusion, pad_frames=True)
    if out is None:
        return without_mask(grow(result, clip, names, tools, extending, options, None, stage))
    sizes = np.concatenate([result.source_size, clip.source_size])
    announce(out, forecast_bytes((len(sizes), *clip.images.shape[1:3]), sizes, saving))
    settings = {
        "extend": [result.frame_names, names, extending.window, extending.anchors],
        "model": model.identity.to_json(),
        "options": options.resolved(model.config.motion).to_json(),
        "fusion": fusion_digest(fusion),
        "versions": versions(),
    }
    with _kept_windows(Path(out), settings) as store:
        both = without_mask(grow(result, clip, names, tools, extending, options, store, stage))
        with stage("write") as progress:
            both.save(out, saving=saving, progress=progress, facts=RunFacts(seconds.seconds))
    return both


def grow(
    result: Reconstruction,
    clip: Clip,
    names: list[str],
    tools: Tools,
    extending: Extending,
    options: Options,
    store: WindowStore | None = None,
    on_stage: OnStage = no_stage,
) -> Reconstruction:
    """Run the windows that are not in the store, those first that overlap most, and return the joined result."""
    with on_stage("compare frames") as progress:
        known, columns = _patches(tools, result.images, progress)
        new, _ = _patches(tools, clip.images, progress)
        growth = Growth(result, clip, names, known, new, columns, extending.least_overlap)

    def run(anchored: Clip, part: range) -> Reconstruction:
        name = window_name(part.start)
        window = None if store is None else store.find(name, anchored.frame_names, in_bytes(anchored.images))
        if window is None:
            window = _agreeing(tools.run(anchored), clip, anchored, part, result, options)
            if store is not None:
                store.save(name, window)
        return window

    parts = extending.parts(len(clip))
    total = len(parts)
    with on_stage("windows") as progress:
        while parts:
            part, anchors = growth.next_part(parts, extending.anchors)
            growth.add(part, anchors, run(growth.anchored(part, anchors), part))
            parts.remove(part)
            (progress or no_progress)(total - len(parts), total)
    return growth.result()


def options_of(result: Reconstruction) -> Options:
    """Return the options that a result was made with, as far as its settings tell, without `refine_cameras`."""
    if result.method not in METHODS:
        raise InputError(f"the result is of {one_line(result.method, 40)}; expected one that vggtjax made")
    row = METHODS[result.method]
    defaults = {"threshold": row.threshold, "mask": row.mask}  # absent from settings where they are the method's own
    names = {field.name for field in dataclasses.fields(Options)} - {"method", "refine_cameras"}
    given: dict[str, Any] = defaults | {name: result.settings[name] for name in names & result.settings.keys()}
    try:
        return Options(**given, method=result.method)  # pyright: ignore[reportArgumentType] - a text, and checked
    except InputError as error:
        raise InputError(f"the settings of the result cannot be taken over: {error}") from error


def check_result(model: Model, result: Reconstruction) -> None:
    """Raise InputError where a result is not of this model, or lacks what anchors need."""
    if not isinstance(result, Reconstruction):
        raise InputError(f"the result is a {type(result).__name__}; expected what Reconstruction.load returns")
    if result.model_name != model.name:
        raise InputError(
            f"the result is of the model {one_line(result.model_name, 60)!r} and {model.name!r} is given; expected the "
            "model that made the result"
        )
    if missing := {"images", "depth_confidence"} & set(missing_fields(result)):
        raise InputError(f"the result has no {' or '.join(sorted(missing))} of its frames; expected one of vggtjax")
    if (patch := result.settings.get("patch")) != model.config.patch_size:
        raise InputError(f"the result has patches of {patch} pixels; expected {model.config.patch_size}, the model's")


def fitter_of(result: Reconstruction) -> Fitter:
    """Return what fits new frames as those of a result are fitted. Raises InputError where its settings do not tell."""
    try:
        return msgspec.convert({name: result.settings[name] for name in ("mode", "size", "patch")}, Fitter)
    except (KeyError, msgspec.ValidationError) as error:
        raise InputError(f"the settings of the result do not tell how its frames were fitted: {error}") from error


def _check_method(result: Reconstruction, options: Options, fusion: FusionParams | None) -> None:
    if options.method != result.method:
        raise InputError(f"method is {options.method!r}; expected that of the result, {result.method!r}")
    if (known := result.settings.get("fusion")) != fusion_digest(fusion):
        if known is None:
            raise InputError("the result was made with the paper's rule of fusion; leave --fusion out")
        raise InputError("the result was made with a fitted rule of fusion; give the same file with --fusion")


def _check_clip(result: Reconstruction, clip: Clip, names: list[str]) -> None:
    sizes = [(array.shape[2], array.shape[1]) for array in (clip.images, result.images)]
    if sizes[0] != sizes[1]:
        (a, b), (c, d) = sizes
        raise InputError(
            f"the new frames are fitted to {a} x {b} pixels and the result has {c} x {d}; expected frames of the same "
            "shape: crop them, or make the result with --preprocess pad"
        )
    if equal := sorted(set(result.frame_names) & set(names)):
        more = f" and {len(equal) - 1} more" if len(equal) > 1 else ""
        raise InputError(
            f"the frame {one_line(equal[0], 60)!r}{more} of the new clip has the name of a frame of the result; give "
            "the new ones a prefix, such as --prefix day2_, or leave out frames that the result has"
        )
    if twice := sorted(name for name, count in Counter(names).items() if count > 1):
        raise InputError(f"two new frames are named {one_line(twice[0], 60)!r}; expected a name for each")


@contextmanager
def _kept_windows(out: Path, settings: Mapping[str, Any]) -> Iterator[WindowStore]:
    """Yield where windows are kept until the result is written, or until the frames turn out not to fit."""
    is_new = not out.is_dir()
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    with locked_folder(out / FOLDER, "the windows of a clip"):
        store = WindowStore(out, settings)
        try:
            with kept(lambda: f"{store.count()} windows are kept; run the same command again to resume"):
                yield store
        except PlaceError:
            store.remove()
            if is_new:
                with suppress(OSError):
                    out.rmdir()
            raise
        store.remove()


def _agreeing(
    window: Reconstruction, clip: Clip, anchored: Clip, part: range, old: Reconstruction, options: Options
) -> Reconstruction:
    """Return a window with depth and cameras by the pixels of its new frames and the stored pictures of its anchors.

    One focal length is looked for where the new frames have the size and the scale of the old ones, so that one camera
    may have taken all; else they stay as predicted.
    """
    count = len(anchored) - len(part)

    def pictures() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        height, width = (int(side) for side in anchored.source_size[0])
        for image in in_bytes(anchored.images[:count]):
            yield np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC))
        yield from islice(clip.pictures(), part.start, part.stop)

    is_one_camera = all(
        len(np.unique(np.concatenate([getattr(old, name), getattr(clip, name)]), axis=0)) == 1
        for name in ("source_size", "source_scale")
    )
    return agree_with_pixels(window, pictures, options, known_intrinsics=not is_one_camera)


def _patches(tools: Tools, images: np.ndarray, progress: Progress | None) -> tuple[Float32[np.ndarray, "F N C"], int]:
    """Return the patches of frames, one frame at a time, and how many are in a row."""
    found, columns = [], 1
    for number, image in enumerate(images, start=1):
        pixels = image / np.float32(255) if image.dtype == np.uint8 else image
        patches, columns = tools.patches(pixels[None])
        found.append(patches[0])
        (progress or no_progress)(number, len(images))
    return np.stack(found), columns
