"""A clip and a model -> a Reconstruction: the stages one by one, or all of them under a single jit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip
from vggtjax.config import Gram, MotionConfig, Suppress, VGGTConfig
from vggtjax.errors import DeviceMemoryError, InputError
from vggtjax.mask import mine_mask
from vggtjax.methods import check_smooth_frames, find_method
from vggtjax.network.backbone import encode
from vggtjax.network.layers import Params
from vggtjax.network.model import Predictions
from vggtjax.passes import Assembly, Passes, assemble, first_pass, run_passes, second_pass, track_from
from vggtjax.refinement import refine_masks
from vggtjax.results.frames import inside_pictures
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.tracking import Queries

OnStage = Callable[[str], AbstractContextManager[Any]]


class Stage(NamedTuple):
    """A jitted function, the arrays that it reads and makes (by name), and its static options."""

    name: str
    reads: tuple[str, ...]
    makes: tuple[str, ...]
    function: Any
    options: dict[str, Any]


def _assemble(first, second, saliency, dynamic_mask, *, method: str, align_scale: bool) -> Assembly:
    return assemble(Passes(first, second, saliency, dynamic_mask), method, align_scale=align_scale)


_encode = jax.jit(encode, static_argnames=("config", "compute_dtype"))
_first_pass = jax.jit(first_pass, static_argnames=("config", "gram", "motion", "outputs", "compute_dtype"))
_mine_mask = jax.jit(mine_mask, static_argnames=("size", "clusters", "threshold", "smooth_frames"))
_second_pass = jax.jit(second_pass, static_argnames=("config", "suppress", "mask_pairs", "compute_dtype"))
_first_pass_with_tracks = jax.jit(
    lambda params, images, patch_tokens, query_points, **options: first_pass(
        params, images, patch_tokens, query_points=query_points, **options
    ),
    static_argnames=("config", "gram", "motion", "outputs", "compute_dtype"),
)
_track_from = jax.jit(track_from, static_argnames=("config", "compute_dtype"))
_same = jax.jit(lambda predictions: predictions)
assembled = jax.jit(_assemble, static_argnames=("method", "align_scale"))


@partial(
    jax.jit,
    static_argnames=(
        "config", "method", "gram", "suppress", "mask_pairs", "motion", "align_scale", "smooth_frames", "compute_dtype",
    ),
)  # fmt: skip
def infer(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    method: str = "4dvggt-d",
    gram: Gram | None = None,
    suppress: Suppress | None = None,
    mask_pairs: int = 5,
    motion: MotionConfig | None = None,
    align_scale: bool = False,
    smooth_frames: int = 1,
    compute_dtype: str = "float32",
) -> tuple[Assembly, Passes]:
    """Run a method on a batch of clips as one compiled function.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1]; H and W are multiples of the patch size.
        config: the model's configuration.
        method: a name of `METHODS`.
        gram, suppress: override the method's own.
        mask_pairs, motion, compute_dtype: as for `run_passes`.
        align_scale: as for `assemble`.
        smooth_frames: as for `mine_mask`.

    Returns:
        The method's depth, confidence and cameras, and the passes that they were made of.
    """
    row = find_method(method)
    passes = run_passes(
        params,
        images,
        config,
        gram=gram or row.gram,
        suppress=suppress or row.suppress,
        mask_pairs=mask_pairs,
        motion=motion,
        compute_dtype=compute_dtype,
        clusters=row.clusters,
        threshold=row.threshold,
        smooth_frames=smooth_frames,
        second=row.needs_second_pass,
    )
    return assemble(passes, method, align_scale=align_scale), passes


def reconstruct(
    model: Model,
    clip: Clip,
    *,
    method: str = "4dvggt-d",
    size: int | None = None,
    gram: Gram | None = None,
    suppress: Suppress | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    smooth_frames: int = 1,
    masks: Bool[np.ndarray, "S H W"] | None = None,
    refine_mask: bool | None = None,
    tracks: Queries | None = None,
    compute_dtype: str = "float32",
    keep_passes: bool = False,
    on_stage: OnStage | None = None,
) -> Reconstruction:
    """Reconstruct a clip: cameras, depth, its confidence, and what moves.

    Args:
        model: what `load_model` returned.
        clip: what `load_clip` returned. It is refitted from its source where its size or patch is not the model's.
        method: a name of `METHODS`.
        size: side in pixels to run at, a multiple of the patch size; the model's own if None.
        gram, suppress: override the method's own similarity and suppression.
        mask_pairs: number of pairs in which the keys of dynamic tokens are suppressed (L_mask of the paper).
        align_scale: bring the second pass to the first one's scale before it is used (not in the paper).
        smooth_frames: odd number of frames that the saliency is averaged over before it is cut (not in the papers).
        masks: what moves, in place of what is mined; without a moving pixel the second pass is the first.
        refine_mask: take out of the mask what agrees with other frames, by the method's depth and cameras (VGGT4D); the
            method's own choice if None.
        tracks: points to follow through the clip, in pixels of its frames as they are given. Those of the first frame
            come with the first pass; every other frame that has some costs a pass of its own, over the clip rolled so
            that this frame comes first.
        compute_dtype: "float32" or "bfloat16" for the blocks' matrix products.
        keep_passes: keep both passes on the result, as `.passes`.
        on_stage: called with the name of each stage, returns a context in which it runs; for progress and timing.

    Raises:
        InputError: an unknown method, masks of another shape than the frames, or a size that is not a multiple of the
            patch size.
        DeviceMemoryError: the clip does not fit.
    """
    row = find_method(method)
    config = model.config
    on_stage = on_stage or (lambda name: nullcontext())
    size = config.image_size if size is None else size
    refine_mask = row.refine if refine_mask is None else refine_mask
    if tracks is not None:
        tracks.check(*clip.images.shape[:3])
    if (clip.size, clip.patch) != (size, config.patch_size):
        with on_stage("fit clip to model"):
            given, clip = clip, clip.refit(size, config.patch_size)
            tracks = None if tracks is None else tracks.moved(given, clip)
    settings = {
        "gram": gram or row.gram,
        "suppress": suppress or row.suppress,
        "mask_pairs": mask_pairs,
        "align_scale": align_scale,
        "smooth_frames": smooth_frames,
        "compute_dtype": compute_dtype,
    }
    stages = _stages(config, method, clip.images.shape[1:3], **settings)
    arrays: dict[str, Any] = {"params": model.params, "images": jnp.asarray(clip.images)[None], "second": None}
    check_smooth_frames(smooth_frames)
    if masks is not None and smooth_frames != 1:
        raise InputError(f"smooth_frames is {smooth_frames} and masks are given; smoothing is for masks that are mined")
    if masks is not None:
        arrays["dynamic_mask"] = jnp.asarray(_checked(masks, clip))[None]
        stages = [stage for stage in stages if stage.name != "dynamic mask"]
        if not masks.any():
            same = Stage("second pass", ("first",), ("second",), _same, {})
            stages = [same if stage.name == same.name else stage for stage in stages]
    if tracks is not None:
        stages = _tracking_stages(stages, tracks, arrays, {"config": config, "compute_dtype": compute_dtype})
    try:
        with on_stage("compile"):
            _compile(stages, arrays)
        for stage in stages:
            with on_stage(stage.name):
                made = jax.block_until_ready(stage.function(*(arrays[name] for name in stage.reads), **stage.options))
                arrays |= dict(zip(stage.makes, made if len(stage.makes) > 1 else (made,), strict=True))
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        S, H, W = clip.images.shape[:3]
        raise DeviceMemoryError(
            f"{S} frames of {W} x {H} pixels do not fit in the memory of the device; take fewer frames "
            "(max_frames, stride, fps), a smaller size, fewer points to track, or bfloat16"
        ) from error
    passes = Passes(arrays["first"], arrays["second"], arrays["saliency"], arrays["dynamic_mask"])
    followed = {} if tracks is None else _joined_tracks(tracks, arrays)
    result = Reconstruction(
        **assembled_fields(arrays["assembly"], arrays[row.intrinsics]),
        saliency=np.asarray(passes.saliency[0]),
        dynamic_mask=np.asarray(passes.dynamic_mask[0]),
        images=np.round(clip.images * 255).astype(np.uint8),
        frame_names=tuple(clip.frame_names),
        timestamps=clip.timestamps,
        method=method,
        model_name=model.name,
        settings=settings
        | {"mode": clip.mode, "size": clip.size, "patch": clip.patch}
        | {"masks": "mined" if masks is None else "given", "refine_mask": refine_mask},
        source_size=clip.source_size,
        source_scale=clip.source_scale,
        source_offset=clip.source_offset,
        valid_box=clip.valid_box,
        **followed,
        passes=jax.tree.map(np.asarray, passes) if keep_passes else None,
    )
    if refine_mask:
        with on_stage("refine mask") as progress:
            result = refined(result, progress)
    return result


def assembled_fields(assembly: Assembly, source: Predictions) -> dict[str, np.ndarray]:
    """Return a method's depth, confidence and cameras of the first clip; its intrinsics are of the pass `source`."""
    depth, confidence, camera_from_world, intrinsics = (np.array(x[0]) for x in jax.tree.leaves(assembly))
    fields = np.asarray(source.pose_encoding)[0][:, [8, 7]]  # of width and height
    focal = intrinsics[:, [0, 1], [0, 1]]
    intrinsics[:, [0, 1], [0, 1]] = np.where(fields > np.pi, -np.abs(focal), focal)  # beyond 2 pi the tangent repeats
    return {
        "depth": depth,
        "depth_confidence": confidence,
        "camera_from_world": camera_from_world,
        "intrinsics": intrinsics,
    }


def _tracking_stages(
    stages: list[Stage], queries: Queries, arrays: dict[str, Any], network: dict[str, Any]
) -> list[Stage]:
    """Return the stages with tracks: of the first frame's points by the first pass, then of every other frame's.

    The points are put into `arrays`.
    """
    stages = list(stages)
    for frame in np.unique(queries.frames).tolist():
        points = jnp.asarray(queries.points[queries.frames == frame])[None]
        if frame == 0:
            arrays["query_points"] = points
            index = next(i for i, stage in enumerate(stages) if stage.name == "first pass")
            reads = (*stages[index].reads, "query_points")
            stages[index] = stages[index]._replace(reads=reads, function=_first_pass_with_tracks)
        else:
            arrays |= {f"points {frame}": points, f"frame {frame}": jnp.int32(frame)}
            reads = ("params", "images", "patch_tokens", f"points {frame}", f"frame {frame}")
            stages.append(Stage("tracks", reads, (f"tracks {frame}",), _track_from, network))
    return stages


def _joined_tracks(queries: Queries, arrays: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the tracks of all query frames in the order of the queries, as fields of a Reconstruction."""
    S, Q = arrays["images"].shape[1], len(queries.frames)
    fields = {
        "track_positions": np.zeros((S, Q, 2), np.float32),
        "track_visibility": np.zeros((S, Q), np.float32),
        "track_confidence": np.zeros((S, Q), np.float32),
    }
    for frame in np.unique(queries.frames).tolist():
        first = arrays["first"]
        made = arrays[f"tracks {frame}"] if frame else (first.tracks, first.track_visibility, first.track_confidence)
        for field, value in zip(fields.values(), made, strict=True):
            field[:, queries.frames == frame] = value[0]
    return fields | {"track_frames": queries.frames}


def _checked(masks: Bool[np.ndarray, "S H W"], clip: Clip) -> Bool[np.ndarray, "S H W"]:
    if masks.shape != clip.images.shape[:3] or masks.dtype != bool:
        raise InputError(f"masks are {masks.dtype} {masks.shape}; expected bool {clip.images.shape[:3]}, as the frames")
    return masks


def refined(result: Reconstruction, progress: Callable[[int, int], object] | None) -> Reconstruction:
    """Return a result whose mask lacks what agrees with other frames, by its own depth and cameras."""
    mask = refine_masks(
        result.images / np.float32(255),
        result.depth,
        result.dynamic_mask,
        result.camera_from_world,
        result.intrinsics,
        valid=inside_pictures(result),
        progress=progress,
    )
    return dataclasses.replace(result, dynamic_mask=mask)


def _stages(
    config: VGGTConfig,
    method: str,
    size: tuple[int, int],
    *,
    gram: Gram,
    suppress: Suppress,
    mask_pairs: int,
    align_scale: bool,
    smooth_frames: int,
    compute_dtype: str,
) -> list[Stage]:
    network = {"config": config, "compute_dtype": compute_dtype}
    masking = {"suppress": suppress, "mask_pairs": mask_pairs}
    making = {"method": method, "align_scale": align_scale}
    row = find_method(method)
    mining = {"size": size, "clusters": row.clusters, "threshold": row.threshold, "smooth_frames": smooth_frames}
    seen = ("params", "images", "patch_tokens")
    stages = [
        Stage("image features", ("params", "images"), ("patch_tokens",), _encode, network),
        Stage("first pass", seen, ("first", "saliency"), _first_pass, network | {"gram": gram}),
        Stage("dynamic mask", ("saliency", "patch_tokens"), ("dynamic_mask",), _mine_mask, mining),
        Stage("second pass", (*seen, "dynamic_mask"), ("second",), _second_pass, network | masking),
        Stage("assemble", ("first", "second", "saliency", "dynamic_mask"), ("assembly",), assembled, making),
    ]
    return [stage for stage in stages if stage.name != "second pass" or row.needs_second_pass]


def _compile(stages: list[Stage], arrays: dict[str, Any]) -> None:
    """Compile every stage for the shapes that it will see; the calls that follow find the result in jit's cache."""
    shapes = dict(arrays)
    for stage in stages:
        lowered = stage.function.lower(*(shapes[name] for name in stage.reads), **stage.options)
        lowered.compile()
        made = lowered.out_info
        shapes |= dict(zip(stage.makes, made if len(stage.makes) > 1 else (made,), strict=True))
