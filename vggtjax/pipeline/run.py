"""A clip and a model -> a Reconstruction: the stages one by one, or all of them under a single jit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip
from vggtjax.clips.queries import Queries
from vggtjax.config import Gram, MotionConfig, Suppress, VGGTConfig
from vggtjax.errors import DeviceMemoryError, InputError
from vggtjax.method.fusion_file import check_fuses, fusion_digest
from vggtjax.method.fusion_rule import FusionParams
from vggtjax.method.passes import Assembly, Passes, assemble, run_passes
from vggtjax.method.refinement import refine_masks
from vggtjax.network.layers import Params
from vggtjax.network.model import Predictions
from vggtjax.options import find_method
from vggtjax.pipeline.frame_padding import padded_frames
from vggtjax.pipeline.stages import StageMemory, compile_stages, stages_of, with_masks, with_tracks
from vggtjax.results.reconstruction import Reconstruction

OnStage = Callable[[str], AbstractContextManager[Any]]


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
        second=row.second_outputs(align_scale) if row.needs_second_pass else (),
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
    fusion: FusionParams | None = None,
    compute_dtype: str = "float32",
    pad_frames: bool = False,
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
        fusion: how the passes are fused, as `load_fusion` returns it; the paper's rule if None. The confidence is then
            the fused precision.
        compute_dtype: "float32" or "bfloat16" for the blocks' matrix products.
        pad_frames: pad the clip to one of a few lengths (`padded_frames`), so that clips of similar length share a
            compilation; what is returned is the same to rounding. Not for clips with tracks.
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
    if fusion is not None:
        check_fuses(method)
    stages = stages_of(config, method, clip.images.shape[:3], all_outputs=keep_passes, **settings)
    S = len(clip)
    room = padded_frames(S, config.motion.offsets) - S if pad_frames and tracks is None else 0

    def padded(frames: np.ndarray) -> Array:
        frames = np.pad(frames, ((0, room), *((0, 0),) * (frames.ndim - 1))) if room else frames
        return jax.device_put(frames[None])

    count = jax.device_put(np.array([S], np.int32)) if room else None
    arrays: dict[str, Any] = {"params": model.params, "images": padded(clip.images)}
    arrays |= {"frame_count": count, "second": None, "fusion": fusion}
    if masks is not None and smooth_frames != 1:
        raise InputError(f"smooth_frames is {smooth_frames} and masks are given; smoothing is for masks that are mined")
    if masks is not None:
        arrays["dynamic_mask"] = padded(_checked(masks, clip))
        stages = with_masks(stages, bool(masks.any()))
    if tracks is not None:
        stages = with_tracks(stages, tracks, arrays)
    with _memory_errors(*clip.images.shape[:3]):
        with on_stage("compile"):
            compile_stages(stages, arrays)
        for stage in stages:
            with on_stage(stage.name):
                arrays |= jax.block_until_ready(stage.run(arrays))
    passes = Passes(arrays["first"], arrays["second"], arrays["saliency"], arrays["dynamic_mask"])
    passes = jax.tree.map(lambda x: np.asarray(x)[:, :S], passes) if room else passes
    followed = {} if tracks is None else _joined_tracks(tracks, arrays)
    result = Reconstruction(
        **assembled_fields(arrays["assembly"], getattr(passes, row.intrinsics)),
        saliency=np.asarray(passes.saliency)[0],
        dynamic_mask=np.asarray(passes.dynamic_mask)[0],
        images=np.round(clip.images * 255).astype(np.uint8),
        frame_names=tuple(clip.frame_names),
        timestamps=clip.timestamps,
        method=method,
        model_name=model.name,
        settings=settings
        | {"mode": clip.mode, "size": clip.size, "patch": clip.patch}
        | {"masks": "mined" if masks is None else "given", "refine_mask": refine_mask}
        | ({} if fusion is None else {"fusion": fusion_digest(fusion)}),
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


@contextmanager
def _memory_errors(frames: int, height: int, width: int) -> Iterator[None]:
    """Say in one sentence that a clip does not fit."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise DeviceMemoryError(
            f"{frames} frames of {width} x {height} pixels do not fit in the memory of the device; take fewer frames "
            "(max_frames, stride, fps), a smaller size, fewer points to track, or bfloat16"
        ) from error


def assembled_fields(assembly: Assembly, source: Predictions) -> dict[str, np.ndarray]:
    """Return a method's depth, confidence and cameras of the first clip; its intrinsics are of the pass `source`."""
    depth, confidence, camera_from_world, intrinsics = (np.array(x)[0] for x in jax.tree.leaves(assembly))
    fields = np.asarray(source.pose_encoding)[0][:, [8, 7]]  # of width and height
    focal = intrinsics[:, [0, 1], [0, 1]]
    intrinsics[:, [0, 1], [0, 1]] = np.where(fields > np.pi, -np.abs(focal), focal)  # beyond 2 pi the tangent repeats
    return {
        "depth": depth,
        "depth_confidence": confidence,
        "camera_from_world": camera_from_world,
        "intrinsics": intrinsics,
    }


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
        valid=result.inside_pictures,
        progress=progress,
    )
    return dataclasses.replace(result, dynamic_mask=mask)


def compile_ahead(
    model: Model,
    frames: int,
    height: int,
    width: int,
    *,
    method: str = "4dvggt-d",
    gram: Gram | None = None,
    suppress: Suppress | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    smooth_frames: int = 1,
    compute_dtype: str = "float32",
    pad_frames: bool = False,
    keep_passes: bool = False,
) -> dict[str, StageMemory]:
    """Compile what `reconstruct` runs with these options for clips of this shape.

    Raises InputError for a shape that is none, or not of the model's patches.
    """
    row, patch = find_method(method), model.config.patch_size
    if frames < 1 or min(height, width) < patch or height % patch or width % patch:
        raise InputError(
            f"{frames} frames of {width} x {height} pixels; expected at least one, with sides that are multiples of "
            f"the patch size {patch}"
        )
    stages = stages_of(
        model.config,
        method,
        (frames, height, width),
        gram=gram or row.gram,
        suppress=suppress or row.suppress,
        mask_pairs=mask_pairs,
        align_scale=align_scale,
        smooth_frames=smooth_frames,
        compute_dtype=compute_dtype,
        all_outputs=keep_passes,
    )
    length = padded_frames(frames, model.config.motion.offsets) if pad_frames else frames
    images = jax.ShapeDtypeStruct((1, length, height, width, 3), jnp.float32)
    count = None if length == frames else jax.ShapeDtypeStruct((1,), jnp.int32)
    arrays = {"params": model.params, "images": images, "frame_count": count, "second": None, "fusion": None}
    with _memory_errors(frames, height, width):
        return compile_stages(stages, arrays)
