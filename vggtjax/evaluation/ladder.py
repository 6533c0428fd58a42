"""The ladder of methods on clips with exact truth: every method, with the mined mask and with the true one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from vggtjax.checkpoint import Model
from vggtjax.clips.truth import ClipTruth, Truth, batched_truth
from vggtjax.config import Gram, MotionConfig, Suppress
from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.depth import depth_errors, measured, median_scale
from vggtjax.evaluation.metrics.masks import auc, jaccard
from vggtjax.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.method.mask import upsample
from vggtjax.method.passes import Assembly, Passes, assemble
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.options import LADDER, Options, find_method
from vggtjax.pipeline.stages import Stages
from vggtjax.storage.programs import Program

MaskSource = Literal["mined", "true"]
Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class LadderRow:
    """What one method scores on one clip.

    A value is None where the truth leaves it undefined (no dynamic pixels, nothing that moves) or where it could not
    be computed, which `failure` then explains. Mask source, pairs and suppression are None for a method without a
    second pass.
    """

    clip: int  # index in the batch
    method: str
    mask_source: MaskSource | None
    mask_pairs: int | None
    suppress: Suppress | None
    abs_rel: float | None  # of depth, after one median scale per clip, which the two below share
    abs_rel_static: float | None
    abs_rel_dynamic: float | None
    delta1: float | None
    rotation_error: float | None  # degrees, mean over frames, relative to frame 0
    centre_error: float | None  # RMSE after Sim(3), in the truth's unit
    centre_error_ratio: float | None  # the same over the clip's median true depth
    saliency_auc: float | None  # of the first pass, over pixels
    mask_jaccard: float | None  # of the mask that the second pass was given
    failure: str = ""


class _Scene(NamedTuple):
    """One clip's truth and what the first pass says of its motion."""

    clip: int
    truth: Truth
    saliency: Float[np.ndarray, "S H W"]


class _Setting(NamedTuple):
    """How the second pass was run, and with which mask (of one clip)."""

    source: MaskSource | None = None
    pairs: int | None = None
    suppress: Suppress | None = None


def _assemble_all(passes: Passes, methods: tuple[str, ...]) -> list[Assembly]:
    return [assemble(passes, method) for method in methods]


_assemble = Program(_assemble_all, static=("methods",))
_upsample = Program(upsample, static=("size",))


def ladder(
    model: Model,
    truth: ClipTruth,
    *,
    methods: Sequence[str] = LADDER,
    masks: Sequence[MaskSource] = ("mined", "true"),
    mask_pairs: Sequence[int] = (5,),
    suppress: Sequence[Suppress] = ("zero",),
    gram: Gram = "cosine",
    motion: MotionConfig | None = None,
    compute_dtype: str = "float32",
    batch_size: int = 4,
    progress: Progress | None = None,
) -> list[LadderRow]:
    """Score methods on clips of one shape; features and first pass are computed once per clip.

    Args:
        model: the network.
        truth: clips with exact truth, [S, ...] or [B, S, ...]; height and width are multiples of the patch size.
        methods: names of `LADDER`. One without a second pass gives one row per clip, any other one for each
            combination of the three that follow.
        masks: "mined" from the first pass, or "true": the truth's own, which bounds what any mining can reach.
        mask_pairs: numbers of pairs in which the keys of dynamic tokens are suppressed.
        suppress: how they are; the methods' own choice is not read.
        gram, motion, compute_dtype: as for `first_pass`.
        batch_size: clips that go through the network together.
        progress: called with the passes done and their number.

    Returns:
        Rows in the order of clips, then mask, pairs, suppression and method, methods without a second pass first.

    Raises:
        InputError: an unknown name, or shapes that do not fit. What a model's odd prediction makes impossible is no
            error: the row says so.
    """
    truth = batched_truth(truth)
    rows = [find_method(method) for method in methods]
    if foreign := [method for method in methods if method not in LADDER]:
        raise InputError(f"methods has {foreign}, which mine their masks in another way; expected some of {LADDER}")
    if unknown := [source for source in masks if source not in ("mined", "true")]:
        raise InputError(f"masks has {unknown}; expected 'mined' or 'true'")
    if unknown := [how for how in suppress if how not in ("zero", "drop")]:
        raise InputError(f"suppress has {unknown}; expected 'zero' or 'drop'")
    if wrong := [pairs for pairs in mask_pairs if pairs != int(pairs) or pairs < 0]:
        raise InputError(f"mask_pairs has {wrong}; expected whole numbers of at least 0")
    if batch_size < 1:
        raise InputError(f"batch_size is {batch_size}; expected at least 1")
    plain = tuple(name for name, row in zip(methods, rows, strict=True) if not row.needs_second_pass)
    masked = tuple(name for name, row in zip(methods, rows, strict=True) if row.needs_second_pass)
    settings = list(product(masks, mask_pairs, suppress)) if masked else []

    frames, height, width = truth.images.shape[1:4]

    def stages(pairs: int = 0, how: Suppress = "zero") -> Stages:
        options = Options(gram=gram, suppress=how, mask_pairs=pairs, compute_dtype=compute_dtype)  # type: ignore[arg-type]
        return Stages(model.config, options, frames, (height, width))

    found: list[LadderRow] = []
    batches = list(_batches(len(truth.images), batch_size))
    done, total = 0, len(batches) * (1 + len(settings))

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for clips, padded in batches:
        images = jax.device_put(truth.images[padded].astype(np.float32, copy=False))
        batch = ClipBatch(images, stages().image_features(model.params, images))
        first, saliency = stages().first_pass(model.params, batch, motion=motion)
        mined = stages().dynamic_mask(saliency, batch.patch_tokens)
        pixels = np.asarray(_upsample(saliency, size=(height, width)))
        scenes = [_Scene(clip, Truth(*(a[clip] for a in truth)), pixels[i]) for i, clip in enumerate(clips)]
        passes = Passes(first, None, saliency, mined)
        found += _scored(passes, plain, scenes, _Setting())
        advance()
        for source, pairs, how in settings:
            mask = mined if source == "mined" else jax.device_put(truth.dynamic_mask[padded])
            second = stages(pairs, how).second_pass(model.params, batch, mask, first)
            found += _scored(Passes(first, second, saliency, mask), masked, scenes, _Setting(source, pairs, how))
            advance()
    return sorted(found, key=lambda row: row.clip)


def _batches(count: int, size: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the clips of each batch, and the same filled up with the last one, so that all have one shape."""
    size = min(size, count)
    for start in range(0, count, size):
        indices = np.arange(start, start + size)
        yield indices[indices < count], np.minimum(indices, count - 1)


def _scored(passes: Passes, methods: tuple[str, ...], scenes: list[_Scene], setting: _Setting) -> Iterator[LadderRow]:
    mask = np.asarray(passes.dynamic_mask)
    for method, made in zip(methods, _assemble(passes, methods=methods), strict=True):
        depth, cameras = np.asarray(made.depth), np.asarray(made.camera_from_world)
        for i, scene in enumerate(scenes):
            yield _row(scene, method, setting, depth[i], cameras[i], mask[i])


def _row(
    scene: _Scene,
    method: str,
    setting: _Setting,
    depth: Float[np.ndarray, "S H W"],
    camera_from_world: Float[np.ndarray, "S 3 4"],
    mask: Bool[np.ndarray, "S H W"],
) -> LadderRow:
    truth, failures = scene.truth, []

    def attempt(function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except InputError as error:
            failures.append(str(error))
            return None

    centres = attempt(centre_error, camera_from_world, truth.camera_from_world)
    there, dynamic = measured(truth.depth), truth.dynamic_mask
    distance = float(np.median(truth.depth[there])) if there.any() else None
    return LadderRow(
        clip=int(scene.clip),
        method=method,
        mask_source=setting.source,
        mask_pairs=setting.pairs,
        suppress=setting.suppress,
        **(attempt(_depth_scores, depth, truth) or dict.fromkeys(_DEPTH_SCORES)),
        rotation_error=attempt(rotation_error, camera_from_world, truth.camera_from_world),
        centre_error=centres,
        centre_error_ratio=None if centres is None or distance is None else centres / distance,
        saliency_auc=attempt(auc, scene.saliency, dynamic) if dynamic.any() and not dynamic.all() else None,
        mask_jaccard=None if setting.source is None else jaccard(mask, dynamic),
        failure="; ".join(failures),
    )


_DEPTH_SCORES = ("abs_rel", "abs_rel_static", "abs_rel_dynamic", "delta1")


def _depth_scores(depth: Float[np.ndarray, "S H W"], truth: Truth) -> dict[str, float | None]:
    scale, there = median_scale(depth, truth.depth), measured(truth.depth)
    everywhere = depth_errors(depth, truth.depth, scale=scale)
    regions = {"abs_rel_static": ~truth.dynamic_mask, "abs_rel_dynamic": truth.dynamic_mask}
    within = {
        name: depth_errors(depth, truth.depth, region, scale=scale).abs_rel if (region & there).any() else None
        for name, region in regions.items()
    }
    return {"abs_rel": everywhere.abs_rel, "delta1": everywhere.delta1, **within}
