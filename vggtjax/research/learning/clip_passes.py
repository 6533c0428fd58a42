"""Both passes over clips with their truth, kept on disk so that later fits take seconds."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, UInt8, jaxtyped

from vggtjax.cameras import Cameras
from vggtjax.clips.clip import load_clip
from vggtjax.errors import InputError, OutputError, ResultError
from vggtjax.method.fusion.family import Observations
from vggtjax.method.fusion.inputs import observe
from vggtjax.method.passes import Passes
from vggtjax.network.checkpoint import Model
from vggtjax.network.model import Predictions
from vggtjax.options import Options
from vggtjax.pipeline.run import reconstruct
from vggtjax.progress import OnStage, Progress, no_progress
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence
from vggtjax.research.learning.fit import FitClips
from vggtjax.research.learning.objectives import View
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.arrays import read_arrays, write_arrays
from vggtjax.storage.cache import cache_folder
from vggtjax.storage.versions import source_digest
from vggtjax.storage.writing import writing

METHOD = "4dvggt-d"

logger = logging.getLogger(__name__)


class ClipPasses(NamedTuple):
    """One clip on the host: the results of both passes, and the truth."""

    depth1: Float32[np.ndarray, "S H W"]
    confidence1: Float32[np.ndarray, "S H W"]
    depth2: Float32[np.ndarray, "S H W"]
    confidence2: Float32[np.ndarray, "S H W"]
    saliency: Float32[np.ndarray, "S h w"]
    dynamic_mask: Bool[np.ndarray, "S H W"]
    images: UInt8[np.ndarray, "S H W 3"]
    camera_from_world: Float32[np.ndarray, "S 3 4"]  # of the second pass
    intrinsics: Float32[np.ndarray, "S 3 3"]
    truth: Float32[np.ndarray, "S H W"]  # depth, 0 where it is unknown
    true_dynamic: Bool[np.ndarray, "S H W"]  # all False where it is unknown


def passes_of(
    result: Reconstruction,
    truth: Float32[np.ndarray, "S H W"] | None,
    true_dynamic: Bool[np.ndarray, "S H W"] | None = None,
) -> ClipPasses:
    """Return the passes that a result kept, with the truth at its pixels; InputError if the result lacks a pass."""
    passes = result.passes
    if passes is None or passes.second is None:
        raise InputError("the result has not kept both passes; reconstruct with keep_passes=True")
    first, second = passes.first, passes.second
    unknown = np.zeros(result.depth.shape, np.float32)
    return ClipPasses(
        *(np.asarray(x)[0] for x in (first.depth, first.depth_confidence, second.depth, second.depth_confidence)),
        saliency=np.asarray(passes.saliency)[0],
        dynamic_mask=np.asarray(passes.dynamic_mask)[0],
        images=result.images,
        camera_from_world=np.asarray(result.camera_from_world, np.float32),
        intrinsics=np.asarray(result.intrinsics, np.float32),
        truth=unknown if truth is None else np.asarray(truth, np.float32),
        true_dynamic=unknown.astype(bool) if true_dynamic is None else np.asarray(true_dynamic, bool),
    )


def kept_passes(key: Mapping[str, Any], make: Callable[[], ClipPasses], folder: Path | None = None) -> ClipPasses:
    """Return the passes kept under a key, or else what `make` returns, and keep that.

    The key holds plain values that name model, clip and settings; the sources of this package and the versions of other
    packages are added. The folder is the user's cache if None; if it cannot be written, a warning is logged.
    """
    versions = [version(name) for name in ("numpy", "pillow", "scipy")]
    text = json.dumps({"sources": source_digest(), "versions": versions, "method": METHOD, **key}, sort_keys=True)
    folder = cache_folder() / "passes" if folder is None else folder
    path = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    if (clip := _read(path)) is not None:
        return clip
    clip = make()
    try:
        with writing(path) as temporary:
            write_arrays(temporary, clip._asdict())
    except OutputError as error:
        logger.warning("passes are not kept: %s", error)
    return clip


def _read(path: Path) -> ClipPasses | None:
    """Return the passes of a file; None where there is no file, or it is damaged."""
    try:
        arrays = read_arrays(path)
    except ResultError:
        return None
    hints = get_type_hints(ClipPasses)
    with jaxtyped("context"):  # sizes of the same letter agree
        whole = set(arrays) == set(hints) and all(isinstance(arrays[name], hint) for name, hint in hints.items())
    return ClipPasses(**arrays) if whole else None


class PassesSettings(TypedDict, total=False):
    """Keywords of `generated_passes` and `dataset_passes`."""

    size: int | None  # side in pixels; the model's own if None
    options: Options | Mapping[str, Any] | None  # or fields of them; method, align_scale, refine_mask change no pass
    folder: Path | None  # of kept passes; the user's cache if None
    on_stage: OnStage | None  # as for `reconstruct`
    progress: Progress | None  # called with the clips done and their number


class _LabelledClip(NamedTuple):
    """A clip with its truth, loaded only if its passes are not kept."""

    name: str
    key: Mapping[str, Any]
    pictures: Callable[[], Any]
    truth: Callable[[Reconstruction], tuple[Any, Any]]  # depth and dynamic pixels at the pixels of a result


def generated_passes(
    model: Model, count: int, *, frames: int = 12, seed: int = 0, **settings: Unpack[PassesSettings]
) -> Iterator[tuple[str, ClipPasses]]:
    """Yield names and passes of generated test scenes with moving things and exact truth.

    Args:
        model: from `load_model`.
        count: number of scenes.
        frames: of each scene, at least 12.
        seed: of the set of scenes; training draws no scene and no texture of it.
        settings: see `PassesSettings`.
    """
    from vggtjax.training.scenes import SceneConfig, held_out_scenes

    side = model.config.clip_size if (size := settings.get("size")) is None else size

    @cache  # all scenes are drawn at once, and only if passes are missing
    def scenes() -> Any:
        return held_out_scenes("dynamic", count, SceneConfig(side, side, frames), seed=seed)

    def labelled(number: int) -> _LabelledClip:
        def truth(_: Reconstruction) -> tuple[Any, Any]:
            return scenes().depth[number], scenes().dynamic_mask[number]

        key = {"scenes": seed, "frames": frames, "scene": number}
        return _LabelledClip(f"scene {seed}-{number}", key, lambda: scenes().images[number], truth)

    yield from _all_passes(model, map(labelled, range(count)), count, **settings)


def dataset_passes(
    model: Model, dataset: str, root: Path, *, max_frames: int | None = None, **settings: Unpack[PassesSettings]
) -> Iterator[tuple[str, ClipPasses]]:
    """Yield names and passes of the sequences of a data set that have true depth; a warning names the others.

    Args:
        model: from `load_model`.
        dataset: a name of `DATASETS`.
        root: folder of the data set, or of one sequence of it.
        max_frames: take at most this many frames of a sequence.
        settings: see `PassesSettings`.

    Raises InputError where no sequence has true depth.
    """
    from vggtjax.clips.media.sampling import Sampling
    from vggtjax.research.evaluation.datasets import DATASETS, find_sequences
    from vggtjax.research.evaluation.truth_at_pixels import TruthAtPixels

    openers = find_sequences(dataset, root, sampling=Sampling(max_frames=max_frames))
    max_depth = DATASETS[dataset].max_depth

    def labelled(name: str, sequence: LabelledSequence) -> _LabelledClip | None:
        if sequence.depth is None or not any((sequence.depth(i) > 0).any() for i in range(len(sequence))):
            logger.warning("%s has no true depth and is left out", name)
            return None

        def truth(result: Reconstruction) -> tuple[Any, Any]:
            at_pixels = TruthAtPixels(sequence, result, max_depth=max_depth)
            has_masks = sequence.mask is not None and bool(at_pixels.masked.all())
            return at_pixels.depth, at_pixels.mask if has_masks else None

        key = {"dataset": [dataset, max_depth], "data": sequence_digest(sequence)}
        return _LabelledClip(name, key, lambda: [str(path) for path in sequence.pictures], truth)

    clips = (labelled(name, opener()) for name, opener in openers.items())
    named = None
    for named in _all_passes(model, clips, len(openers), **settings):
        yield named
    if named is None:
        raise InputError(f"no sequence of {root} has true depth; a fusion cannot be fitted to it")


def _all_passes(
    model: Model,
    clips: Iterable[_LabelledClip | None],
    count: int,
    *,
    size: int | None = None,
    options: Options | Mapping[str, Any] | None = None,
    folder: Path | None = None,
    on_stage: OnStage | None = None,
    progress: Progress | None = None,
) -> Iterator[tuple[str, ClipPasses]]:
    """Yield names and passes of `count` clips; None stands for a clip that is left out."""
    size = model.config.clip_size if size is None else size
    options = options if isinstance(options, Options) else Options(**(options or {}))
    as_in_the_paper = {"align_scale": False, "refine_mask": False, "refine_cameras": False, "consistent_depth": False}
    options = options.changed(method=METHOD, **as_in_the_paper)
    common = {"model": model.identity.sha256, "size": size, "options": options.passes_settings(model.config.motion)}

    def passes(clip: _LabelledClip) -> ClipPasses:
        frames = load_clip(clip.pictures(), model=model, size=size)
        result = reconstruct(model, frames, options=options, size=size, keep_passes=True, on_stage=on_stage)
        return passes_of(result, *clip.truth(result))

    for done, clip in enumerate(clips, 1):
        if clip is not None:
            yield clip.name, kept_passes(common | dict(clip.key), partial(passes, clip), folder)
        (progress or no_progress)(done, count)


def sequence_digest(sequence: LabelledSequence) -> str:
    """Return a digest of a sequence: size and date of its pictures, its cameras, and all its true depth and masks."""
    from vggtjax.research.evaluation.run import fingerprint

    digest = hashlib.sha256(fingerprint(sequence).encode())
    for read in (sequence.depth, sequence.mask):
        digest.update(b"-" if read is None else b"+")
        for array in () if read is None else map(read, range(len(sequence))):
            digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def observations(clip: ClipPasses) -> Observations:
    """Return the inputs of a fusion rule for a clip, [S, H, W], on the host."""
    first = Predictions(depth=jnp.asarray(clip.depth1)[None], depth_confidence=jnp.asarray(clip.confidence1)[None])
    second = Predictions(depth=jnp.asarray(clip.depth2)[None], depth_confidence=jnp.asarray(clip.confidence2)[None])
    passes = Passes(first, second, jnp.asarray(clip.saliency)[None], jnp.asarray(clip.dynamic_mask)[None])
    return jax.tree.map(lambda x: np.asarray(x)[0], _observe(passes))


_observe = jax.jit(observe)


def fit_clips(
    clips: Sequence[ClipPasses],
    seen: Sequence[Observations],
    *,
    pixels: int | None = None,
    frames: int | None = None,
    seed: int = 0,
) -> FitClips:
    """Return clips stacked for a fit.

    Args:
        clips: of any sizes if `pixels` is given; else clips of fewer frames or a smaller size are padded with pixels of
            unknown depth.
        seen: `observations` of each clip.
        pixels: number of pixels of true depth to draw from each clip (repeatedly where a clip has fewer).
        frames: without `pixels`, number of consecutive frames to take of each clip: those of most true depth.
        seed: of the draw of pixels.

    Raises InputError without clips, or where pixels are drawn from a clip without true depth.
    """
    if not clips:
        raise InputError("there are no clips to fit to; expected at least one")
    generator = np.random.default_rng(seed)
    stacked = [
        _at_pixels(clip, maps, pixels, generator) if pixels else _whole(clip, maps, frames)
        for clip, maps in zip(clips, seen, strict=True)
    ]
    largest = tuple(max(sizes) for sizes in zip(*(clip.truth.shape for clip in stacked), strict=True))
    same_size = all(clip.view is not None and clip.view.images.shape[:3] == largest for clip in stacked)

    def padded(x: Any, mode: Any) -> np.ndarray:
        widths = [(0, side - own) for side, own in zip(largest, x.shape, strict=False)]
        return np.pad(x, widths + [(0, 0)] * (x.ndim - 3), mode=mode)

    clips_padded = [
        FitClips(
            jax.tree.map(lambda x: padded(x, "edge"), clip.seen),
            padded(clip.truth, "constant"),  # pyright: ignore[reportArgumentType]
            clip.view if same_size else None,
        )
        for clip in stacked
    ]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *clips_padded)


def _whole(clip: ClipPasses, seen: Observations, frames: int | None) -> FitClips:
    S = len(clip.truth)
    count = S if frames is None else min(frames, S)
    known = np.cumsum([0, *(clip.truth > 0).sum(axis=(1, 2))])
    best = int(np.argmax(known[count:] - known[: S - count + 1]))
    part = slice(best, best + count)
    seen = jax.tree.map(lambda x: x[part], seen)
    cameras = Cameras(clip.camera_from_world[part], clip.intrinsics[part])
    view = View(clip.images[part].astype(np.float32) / 255, cameras)  # pyright: ignore[reportArgumentType]
    return FitClips(seen, clip.truth[part], view)  # pyright: ignore[reportArgumentType]


def _at_pixels(clip: ClipPasses, seen: Observations, count: int, generator: np.random.Generator) -> FitClips:
    known = np.flatnonzero(np.isfinite(clip.truth) & (clip.truth > 0))
    if not len(known):
        raise InputError("a clip has no pixel with a true depth; leave it out")
    chosen = generator.choice(known, count, replace=len(known) < count)

    def taken(x) -> np.ndarray:
        return x.reshape(-1, *x.shape[3:])[chosen][None, None]

    return FitClips(jax.tree.map(taken, seen), taken(clip.truth))  # pyright: ignore[reportArgumentType]
