"""A clip and a model -> a Reconstruction, stage by stage."""

from __future__ import annotations

import dataclasses
import time
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from vggtjax.cameras import world_from_camera
from vggtjax.clips.clip import Clip
from vggtjax.clips.fingerprint import source_setting
from vggtjax.clips.queries import Queries
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, ResultError, device_memory_errors
from vggtjax.method.algorithm import Clips, compute_by, run_method
from vggtjax.method.assembly import Assembly, FusionRule, as_tree, check_fuses
from vggtjax.method.mask_refinement import refine_masks
from vggtjax.method.passes import Passes
from vggtjax.network.checkpoint import Model, check_finite
from vggtjax.network.heads.pose import encode_pose
from vggtjax.network.kernels.frames import BY_FRAME, REPLICATED, Frames
from vggtjax.network.surroundings import own_settings
from vggtjax.options import Options
from vggtjax.pipeline.agreement import agree_with_pixels, agrees_with_pixels
from vggtjax.pipeline.devices import frames_mesh, on_host, replicate, shard_frames, shared_length
from vggtjax.pipeline.fields import (
    assembled_fields,
    clip_fields,
    kept_passes,
    motion_by_matches,
    reference_setting,
    settings_of,
    track_fields,
)
from vggtjax.pipeline.inputs import GivenMasks, Inputs, read_inputs
from vggtjax.pipeline.known.apply import apply_known, scaled
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.lengths import padded_frames
from vggtjax.pipeline.refinement.refine import check_refinement
from vggtjax.pipeline.running import Running, changed, check_kinds
from vggtjax.pipeline.steps import Compile, Execute, StageMemory
from vggtjax.progress import OnStage, Progress
from vggtjax.results.not_finite import warn_of_not_finite
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import without_mask
from vggtjax.storage.cache import hint_compilation_cache

_LESS_MEMORY = (
    "fewer frames at once (window, max_frames, stride, fps), a smaller size, fewer points to track, or bfloat16"
)


@own_settings()
def reconstruct(
    model: Model,
    clip: Clip | ClipSource,
    *,
    options: Options = Options(),
    size: int | None = None,
    masks: GivenMasks | None = None,
    tracks: Queries | None = None,
    fusion: FusionRule | None = None,
    known: KnownGeometry | None = None,
    running: Running = Running(),
    **changes: Any,
) -> Reconstruction:
    """Reconstruct a clip: cameras, depth, its confidence, and what moves.

    Args:
        model: what `load_model` returned.
        clip: what `load_clip` returned, or a source that it loads, such as "clip.mp4". A clip of another size than
            `size`, or of another patch size than the model's, is read from its source again.
        options: the method and its settings.
        size: side in pixels to run at, a multiple of the patch size; the model's own if None.
        masks: dynamic regions, instead of the mined masks: boolean at the size of the clip's frames, as given or as
            fitted, or of the source's images, or a folder of images; False: nothing is dynamic. If no pixel is dynamic,
            the second pass is skipped. It is also skipped if masks are mined and all frames are identical.
        tracks: points to follow, in pixels of the frames; each frame after the first with points costs a pass.
        fusion: a fitted rule (`load_fusion`) or a function, as for `assemble`, whose precision is the confidence; None:
            the paper's rule.
        known: intrinsics, poses or lengths that are known, and pixels without depth: the prediction is brought to them.
        running: devices, padded lengths, kept passes, and what is told of the stages.
        changes: fields of `options` or of `running` by name, such as `method="vggt4d"` or `devices=2`.

    A NotFiniteWarning tells how much of depth, confidence and saliency is NaN or infinite.

    Raises:
        InputError: an invalid option, masks of another size, a size that is not a multiple of the patch size, known
            geometry that does not fit the clip, or more devices than there are.
        CheckpointError: the model has parameters that are not finite, and so has its prediction.
        ClipError: the source of the clip cannot be read.
        DeviceMemoryError: the clip does not fit in the memory of the device.
        MissingExtraError: cameras are to be refined, and pycolmap is not installed.
    """
    check_kinds(model=model, options=options, running=running, tracks=tracks, known=known)
    options, running = changed(options, running, changes)
    if masks is not None:
        options.check_given_masks()
    options = options.resolved(model.config.motion)
    _check(model, options, running, tracks, fusion, known)
    clip = clip if isinstance(clip, Clip) else open_source(clip)
    source = clip.source if isinstance(clip, Clip) else clip
    of_source = {} if running.is_part else source_setting(source)  # as it is before the work
    inputs = read_inputs(model, clip, size=size, masks=masks, tracks=tracks, known=known, on_stage=running.stage)

    cameras = read_cameras(model, inputs)
    run = partial(run_method, **_arguments(model, inputs, cameras, options, running, fusion))
    with device_memory_errors(_LESS_MEMORY, *inputs.clip.images.shape[:3]):
        started = time.perf_counter()
        with running.stage("compile programs") as progress:
            compiler = Compile()
            run(step=compiler)  # its steps take and return shapes
            compiler.wait(progress)
        hint_compilation_cache(time.perf_counter() - started)
        outputs = run(step=Execute(running.stage))
        reference = {} if cameras is not None else reference_setting(outputs[1].features, inputs.clip, options)
        outputs = _on_host(outputs, len(inputs.clip.images))
        del run  # with its arrays on the devices

    result = _result(model, inputs, cameras is not None, options, running, fusion, outputs)
    result = dataclasses.replace(result, settings=result.settings | reference)
    warn_of_not_finite(result)
    result, unit = _with_geometry(result, inputs, options, running.stage)
    if options.refine_mask and result.has_mask:
        with running.stage("refine mask") as progress:
            result = refined(result, progress, unit)
    result = dataclasses.replace(result, settings=result.settings | of_source)
    return result if running.is_part else without_mask(result)


@own_settings()
def compile_ahead(
    model: Model,
    frames: int,
    height: int,
    width: int,
    *,
    options: Options = Options(),
    running: Running = Running(),
    **changes: Any,
) -> dict[str, StageMemory]:
    """Compile ahead of time what `reconstruct` runs with these options for a clip of this shape.

    Later calls for this shape in this process start at once, and so do those of other processes where compilations are
    kept (as the command line does).

    Returns:
        The memory of each stage on each device beside its inputs, by XLA's own analysis: `.temporary` and `.output`
        bytes; and `.collectives`, the number of communications between devices by kind.

    Raises:
        InputError: an invalid option, no frame, sides that are not multiples of the model's patch size, or more devices
            than there are.
        DeviceMemoryError: the clip does not fit in the memory of the device.
    """
    check_kinds(model=model, options=options, running=running)
    patch = model.config.patch_size
    if frames < 1 or min(height, width) < patch or height % patch or width % patch:
        raise InputError(
            f"{frames} frames of {width} x {height} pixels; expected at least one frame, with sides that are multiples "
            f"of the patch size {patch}"
        )
    options, running = changed(options, running, changes)
    options, mesh = options.resolved(model.config.motion), frames_mesh(running.devices)
    length = padded_frames(frames, model.config.motion.offsets) if running.pad_frames else frames
    by_frame, whole = (Frames(mesh).sharding(spec) for spec in (BY_FRAME, REPLICATED))
    shape = (1, shared_length(length, mesh), height, width, 3)
    clips = Clips(
        images=jax.ShapeDtypeStruct(shape, jnp.float32, sharding=by_frame),  # type: ignore
        frames=frames,
    )
    params = model.params
    if mesh is not None:
        params = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=whole), params)
    compiler = Compile()
    how = {"compute": compute_by(options, Frames(mesh, None if mesh is None else length)), "step": compiler}
    with device_memory_errors(_LESS_MEMORY, frames, height, width):
        run_method(params, clips, model.config, options, both_outputs=running.keep_passes, **how)
        return compiler.wait()


def refined(result: Reconstruction, progress: Progress | None, unit: float = 1.0) -> Reconstruction:
    """Return the result with a mask without the pixels that agree with other frames, by its depth and cameras.

    `unit` is how long the network's unit is in units of the result.
    """
    own = result if unit == 1 else scaled(result, 1 / unit)
    images, cameras = result.images / np.float32(255), (own.camera_from_world, own.intrinsics)
    seen = result.inside_pictures & (result.depth != 0)
    mask = refine_masks(images, own.depth, result.dynamic_mask, *cameras, valid=seen, progress=progress)
    return dataclasses.replace(result, dynamic_mask=mask)


def _check(
    model: Model,
    options: Options,
    running: Running,
    tracks: Queries | None,
    fusion: FusionRule | None,
    known: KnownGeometry | None,
) -> None:
    """Raise InputError for arguments that exclude each other or suit no such network, or for too many devices."""
    frames_mesh(running.devices)
    if options.reference != "chosen" and not model.config.row.chooses_reference:
        raise InputError(f"reference is {options.reference!r}; leave it out, as this network takes the first frame")
    if running.devices != 1 and tracks is not None:
        raise InputError(
            f"devices is {running.devices} and points are to be tracked, which takes one device; leave one out"
        )
    check_fuses(fusion, options.method)
    poses_are_known = known is not None and known.poses is not None
    check_refinement(options.refine_cameras, poses_are_known)


def _arguments(
    model: Model,
    inputs: Inputs,
    cameras: Float32[np.ndarray, "S 9"] | None,
    options: Options,
    running: Running,
    fusion: FusionRule | None,
) -> dict[str, Any]:
    """Return the arguments of `run_method` for a clip, on the devices that compute them."""
    clip, tracks, masks, mesh = inputs.clip, inputs.tracks, inputs.masks, frames_mesh(running.devices)
    is_padded = running.pad_frames and tracks is None
    frames = len(clip.images)
    length = padded_frames(frames, model.config.motion.offsets) if is_padded else frames
    padding = shared_length(length, mesh) - frames

    def padded(x: np.ndarray, **mode: Any) -> Array:
        return shard_frames(np.pad(x, ((0, padding), *((0, 0),) * (x.ndim - 1)), **mode)[None], mesh)

    params, rule = model.params, as_tree(fusion)
    if mesh is not None:
        params, rule = replicate((params, rule), mesh)
    mines = options.row.needs_second_pass or agrees_with_pixels(options) or running.keep_passes or running.is_part
    moving: Array | Literal[False] | None = None if mines else False
    if masks is not None:
        moving = padded(masks) if masks.any() else False
    return {
        "params": params,
        "clips": Clips(
            images=padded(clip.images),
            query_points={} if tracks is None else replicate(_points_by_frame(tracks), mesh),
            frames=frames,
            cameras=None if cameras is None else padded(cameras, mode="edge"),
        ),
        "config": model.config,
        "options": options,
        "masks": moving,
        "fusion": rule,
        "both_outputs": running.keep_passes,
        "compute": compute_by(options, Frames(mesh, None if mesh is None else length)),
    }


def read_cameras(model: Model, inputs: Inputs) -> Float32[np.ndarray, "S 9"] | None:
    """Return known cameras as the network reads them: None unless it reads any, and poses and intrinsics are known."""
    given, (height, width) = inputs.geometry, inputs.clip.images.shape[1:3]
    if not model.config.reads_cameras or given is None or given.poses is None or given.intrinsics is None:
        return None
    poses = world_from_camera(np.asarray(given.poses)[:, :3])[:, :3]
    return np.asarray(encode_pose(jnp.asarray(poses), jnp.asarray(given.intrinsics), (height, width)), np.float32)


def _on_host(outputs: tuple[Assembly, Passes], frames: int) -> tuple[Assembly, Passes]:
    """Return what the method made on the host, without padded frames and the features of the backbone."""
    outputs = outputs[0], outputs[1]._replace(features=None)
    return jax.tree.map(lambda x: on_host(x)[:, :frames], outputs)


def _result(
    model: Model,
    inputs: Inputs,
    cameras_are_read: bool,
    options: Options,
    running: Running,
    fusion: FusionRule | None,
    outputs: tuple[Assembly, Passes],
) -> Reconstruction:
    """Return what the method made of the clip. Raises CheckpointError where parameters are not finite."""
    clip, tracks, (assembly, passes) = inputs.clip, inputs.tracks, outputs
    motion, mask_source = motion_by_matches(passes, inputs.mask_source)
    tracked = {} if tracks is None or passes.tracks is None else track_fields(tracks, passes.tracks, len(clip.images))
    try:
        return Reconstruction(
            **assembled_fields(
                assembly,
                getattr(passes, options.row.intrinsics),
                clip,
                world_is_first=model.config.row.world_is_first or cameras_are_read,
            ),
            **clip_fields(clip),
            **tracked,
            saliency=np.asarray(passes.saliency[0]),
            motion=motion,
            dynamic_mask=np.asarray(passes.dynamic_mask[0]),
            method=options.method,
            model_name=model.name,
            settings=settings_of(model, clip, options, mask_source, fusion)
            | ({"cameras": "known, read by the network"} if cameras_are_read else {}),
            passes=kept_passes(passes) if running.keep_passes else None,
        )
    except ResultError:
        check_finite(model)  # they may be the reason
        raise


def _with_geometry(
    result: Reconstruction, inputs: Inputs, options: Options, on_stage: OnStage
) -> tuple[Reconstruction, float]:
    """Return the result by pixels and by what is known, and how long the network's unit is in units of the result."""
    geometry = inputs.geometry

    def agree(result: Reconstruction) -> Reconstruction:
        return agree_with_pixels(
            result,
            inputs.clip.pictures,
            options,
            known_poses=geometry is not None and geometry.poses is not None,
            known_intrinsics=geometry is not None and geometry.intrinsics is not None,
            on_stage=on_stage,
        )

    if geometry is None:
        return agree(result), 1.0
    if agrees_with_pixels(options):
        return apply_known(result, geometry, agree)
    with on_stage("known geometry"):
        return apply_known(result, geometry)


def _points_by_frame(queries: Queries) -> dict[int, Float[Array, "1 Q 2"]]:
    """Return the points to track by the frame in which they are given."""
    return {
        frame: jnp.asarray(queries.points[queries.frames == frame])[None]
        for frame in np.unique(queries.frames).tolist()
    }
