"""Both passes over clips with their truth, kept on disk so that a fit takes seconds once they were made."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from vggtjax.checkpoint import Model
from vggtjax.errors import InputError, ResultError
from vggtjax.learning.fit import FitClips
from vggtjax.learning.objectives import View
from vggtjax.method.fusion_inputs import observe
from vggtjax.method.fusion_rule import Observations
from vggtjax.method.passes import Cameras, Passes
from vggtjax.network.model import Predictions
from vggtjax.pipeline.run import reconstruct
from vggtjax.progress import OnStage
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays as archive
from vggtjax.storage.cache import cache_folder
from vggtjax.storage.programs import source_digest
from vggtjax.storage.writing import writing

METHOD = "4dvggt-d"
_LOOKED_AT = 64  # values of every parameter that tell models apart

logger = logging.getLogger(__name__)


class ClipPasses(NamedTuple):
    """One clip on the host: what its passes found, and what is true."""

    depth1: Float32[np.ndarray, "S H W"]
    confidence1: Float32[np.ndarray, "S H W"]
    depth2: Float32[np.ndarray, "S H W"]
    confidence2: Float32[np.ndarray, "S H W"]
    saliency: Float32[np.ndarray, "S h w"]
    dynamic_mask: Bool[np.ndarray, "S H W"]
    images: UInt8[np.ndarray, "S H W 3"]
    camera_from_world: Float32[np.ndarray, "S 3 4"]  # of the second pass
    intrinsics: Float32[np.ndarray, "S 3 3"]
    truth: Float32[np.ndarray, "S H W"]  # depth, 0 where it is not known
    true_dynamic: Bool[np.ndarray, "S H W"]  # all False where it is not known


def passes_of(
    result: Reconstruction,
    truth: Float32[np.ndarray, "S H W"] | None,
    true_dynamic: Bool[np.ndarray, "S H W"] | None = None,
) -> ClipPasses:
    """Return the passes of a result that kept them, next to the truth at its pixels."""
    passes = result.passes
    if passes is None or passes.second is None:
        raise InputError("the result has not kept both passes; reconstruct with keep_passes=True")
    first, second = passes.first, passes.second
    nothing = np.zeros(result.depth.shape, np.float32)
    return ClipPasses(
        *(np.asarray(x)[0] for x in (first.depth, first.depth_confidence, second.depth, second.depth_confidence)),
        saliency=np.asarray(passes.saliency)[0],
        dynamic_mask=np.asarray(passes.dynamic_mask)[0],
        images=result.images,
        camera_from_world=np.asarray(result.camera_from_world, np.float32),
        intrinsics=np.asarray(result.intrinsics, np.float32),
        truth=nothing if truth is None else np.asarray(truth, np.float32),
        true_dynamic=nothing.astype(bool) if true_dynamic is None else np.asarray(true_dynamic, bool),
    )


def kept_passes(key: Mapping[str, Any], make: Callable[[], ClipPasses], folder: Path | None = None) -> ClipPasses:
    """Return what `make` makes, or what it made before under the same key.

    Args:
        key: plain values that name model, clip and settings: all that the passes depend on, but for the sources of this
            package and the versions below it, which are added.
        make: runs the passes.
        folder: of the kept files; the user's cache if None.
    """
    text = json.dumps({"sources": source_digest(), "method": METHOD, **key}, sort_keys=True)
    folder = cache_folder() / "passes" if folder is None else folder
    path = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    try:
        stored = archive.read_arrays(path)
        if set(stored) == set(ClipPasses._fields):
            return ClipPasses(**stored)
    except ResultError:  # not there, or not whole
        pass
    made = make()
    with writing(path) as temporary:
        archive.write_arrays(temporary, made._asdict())
    return made


def generated_passes(
    model: Model,
    count: int,
    *,
    frames: int = 12,
    size: int | None = None,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    folder: Path | None = None,
    on_stage: OnStage | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Iterator[tuple[str, ClipPasses]]:
    """Yield names and passes of generated test scenes in which things move, with exact truth.

    Args:
        model: what `load_model` returned.
        count: number of scenes.
        frames: of each, 12 at least.
        size: side in pixels; the model's own if None.
        seed: of the set; training draws no scene and no texture of it.
        options: keywords of `reconstruct`.
        folder: of kept passes; the user's cache if None.
        progress: called with the scenes done and their number.
    """
    from vggtjax.clips.clip import load_clip
    from vggtjax.scenes import SceneConfig, held_out_scenes

    side = model.config.image_size if size is None else size
    key = {"model": identity_of(model), "scenes": seed, "frames": frames, "size": side, "options": options}
    drawn: list[Any] = []  # all at once, and only if one is missing

    def made(scene: int) -> ClipPasses:
        if not drawn:
            drawn.append(held_out_scenes("dynamic", count, SceneConfig(side, side, frames), seed=seed))
        truth = jax.tree.map(lambda x: x[scene], drawn[0])
        clip = load_clip(truth.images, size=side, patch=model.config.patch_size)
        result = reconstruct(
            model, clip, method=METHOD, size=side, keep_passes=True, on_stage=on_stage, **dict(options or {})
        )
        return passes_of(result, truth.depth, truth.dynamic_mask)

    for scene in range(count):
        yield (
            f"scene {seed}-{scene}",
            kept_passes(key | {"scene": scene}, lambda scene=scene: made(scene), folder),
        )
        if progress is not None:
            progress(scene + 1, count)


def dataset_passes(
    model: Model,
    dataset: str,
    root: Path,
    *,
    max_frames: int | None = None,
    size: int | None = None,
    options: Mapping[str, Any] | None = None,
    folder: Path | None = None,
    on_stage: OnStage | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Iterator[tuple[str, ClipPasses]]:
    """Yield names and passes of a data set's sequences that have true depth; arguments as above, and as `evaluate`.

    A sequence without is left out, and said to be in the log.

    Raises InputError where no sequence has.
    """
    from vggtjax.clips.clip import load_clip
    from vggtjax.evaluation.datasets import DATASETS, find_sequences
    from vggtjax.evaluation.protocol import TruthAtPixels
    from vggtjax.evaluation.run import fingerprint

    side = model.config.image_size if size is None else size
    found, used = find_sequences(dataset, root, max_frames=max_frames), 0
    max_depth = DATASETS[dataset].max_depth
    key = {"model": identity_of(model), "dataset": [dataset, max_depth], "size": side, "options": options}
    for number, (name, opener) in enumerate(found.items()):
        sequence = opener()
        if sequence.depth is not None and any((sequence.depth(i) > 0).any() for i in range(len(sequence))):
            used += 1

            def made(sequence=sequence) -> ClipPasses:
                paths = [str(path) for path in sequence.pictures]
                clip = load_clip(paths, size=side, patch=model.config.patch_size)
                result = reconstruct(
                    model, clip, method=METHOD, size=side, keep_passes=True, on_stage=on_stage, **dict(options or {})
                )
                truth = TruthAtPixels(sequence, result, max_depth=max_depth)
                return passes_of(result, truth.depth, None if sequence.mask is None else truth.mask)

            yield name, kept_passes(key | {"data": fingerprint(sequence)}, made, folder)
        else:
            logger.warning("%s has no true depth and is left out", name)
        if progress is not None:
            progress(number + 1, len(found))
    if not used:
        raise InputError(f"no sequence of {root} has true depth; a fusion cannot be fitted to it")


def identity_of(model: Model) -> str:
    """Return what tells models apart: the configuration, some values of every parameter, and the sum of the file."""
    digest = hashlib.sha256(model.config.to_json().encode())
    for leaf in jax.tree.leaves(model.params):
        values = np.asarray(leaf).reshape(-1)
        digest.update(f"{leaf.dtype} {leaf.shape}".encode())
        digest.update(values[:: max(values.size // _LOOKED_AT, 1)].tobytes() if model.path else values.tobytes())
    if model.path is not None:
        with model.path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def observations(clip: ClipPasses, patch_size: int) -> Observations:
    """Return what rules of fusion see of a clip, [S, H, W], on the host."""
    first = Predictions(depth=jnp.asarray(clip.depth1)[None], depth_confidence=jnp.asarray(clip.confidence1)[None])
    second = Predictions(depth=jnp.asarray(clip.depth2)[None], depth_confidence=jnp.asarray(clip.confidence2)[None])
    passes = Passes(first, second, jnp.asarray(clip.saliency)[None], jnp.asarray(clip.dynamic_mask)[None])
    return jax.tree.map(lambda x: np.asarray(x)[0], _observe(passes, patch_size))


_observe = jax.jit(observe, static_argnums=1)


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
        clips: of any sizes where `pixels` is given; else those of fewer frames or a smaller size are filled up with
            pixels of unknown depth.
        seen: what `observations` returned for each.
        pixels: take so many pixels with a true depth of each clip, at random (some twice where it has fewer).
        frames: else take so many frames of each, next to each other: those with the most true depth.
        seed: of the choice of pixels.

    Raises:
        InputError: no clips, or one without a true depth where pixels are taken.
    """
    if not clips:
        raise InputError("there are no clips to fit to; expected one at least")
    generator = np.random.default_rng(seed)
    stacked = [
        _at_pixels(clip, maps, pixels, generator) if pixels else _whole(clip, maps, frames)
        for clip, maps in zip(clips, seen, strict=True)
    ]
    most = [max(sizes) for sizes in zip(*(clip.truth.shape for clip in stacked), strict=True)]

    def filled(x: np.ndarray) -> np.ndarray:
        room = [(0, whole - there) for whole, there in zip(most, x.shape, strict=False)]
        return np.pad(x, room + [(0, 0)] * (x.ndim - 3), mode="edge")

    maps = [clip._replace(seen=jax.tree.map(filled, clip.seen)) for clip in stacked]
    maps = [
        clip._replace(truth=np.pad(clip.truth, [(0, w - t) for w, t in zip(most, clip.truth.shape, strict=True)]))
        for clip in maps
    ]
    views = [clip.view for clip in maps]
    alike = all(view is not None and view.images.shape[:3] == tuple(most) for view in views)
    together = [clip if alike else clip._replace(view=None) for clip in maps]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *together)


def _whole(clip: ClipPasses, seen: Observations, frames: int | None) -> FitClips:
    S = len(clip.truth)
    count = S if frames is None else min(frames, S)
    known = np.cumsum([0, *(clip.truth > 0).sum(axis=(1, 2))])
    best = int(np.argmax(known[count:] - known[: S - count + 1]))
    some = slice(best, best + count)
    seen = jax.tree.map(lambda x: x[some], seen)
    cameras = Cameras(clip.camera_from_world[some], clip.intrinsics[some])  # pyright: ignore[reportArgumentType]
    view = View(clip.images[some].astype(np.float32) / 255, cameras)  # pyright: ignore[reportArgumentType]
    return FitClips(seen, clip.truth[some], view)  # pyright: ignore[reportArgumentType]


def _at_pixels(clip: ClipPasses, seen: Observations, count: int, generator: np.random.Generator) -> FitClips:
    known = np.flatnonzero(np.isfinite(clip.truth) & (clip.truth > 0))
    if not len(known):
        raise InputError("a clip has no pixel with a true depth; leave it out")
    chosen = generator.choice(known, count, replace=len(known) < count)

    def taken(x) -> np.ndarray:
        return x.reshape(-1, *x.shape[3:])[chosen][None, None]

    return FitClips(jax.tree.map(taken, seen), taken(clip.truth))  # pyright: ignore[reportArgumentType]
