"""The ladder of methods on clips with exact truth: each method with masks by cues, by matches, and true ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, count, product
from typing import Any, Literal, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float

from vggtjax.cameras import Similarity, checked_centres, umeyama_sim3
from vggtjax.clips.truth import ClipTruth, Truth, batched_truth
from vggtjax.config import Suppress
from vggtjax.errors import InputError
from vggtjax.method.algorithm import Clips, run_passes
from vggtjax.method.assembly import Assembly, assemble
from vggtjax.method.mask import upsample
from vggtjax.method.matching.matched_mask import motion_pixels
from vggtjax.method.passes import Passes
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.pose import encode_pose
from vggtjax.options import ABLATION, Options, find_method
from vggtjax.pipeline.steps import Execute
from vggtjax.progress import Progress
from vggtjax.research.evaluation.metrics.depth import depth_errors, measured, median_scale
from vggtjax.research.evaluation.metrics.masks import auc, jaccard
from vggtjax.research.evaluation.metrics.point_clouds import paired_distance
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.research.evaluation.truth_at_pixels import known_points
from vggtjax.results.reconstruction import Reconstruction

MaskSource = Literal["mined", "matches", "true"]


@dataclass(frozen=True)
class LadderRow:
    """The scores of one method on one clip.

    A value is None where the truth leaves it undefined (no dynamic pixels, cameras that do not move), or where its
    computation failed for the reason in `failure`. Mask source, pairs and suppression are None for a method without a
    second pass.
    """

    clip: int  # index in the batch
    method: str
    mask_source: MaskSource | Literal["pixels"] | None
    mask_pairs: int | None
    suppress: Suppress | None
    abs_rel: float | None  # of depth, after one median scale per clip
    abs_rel_static: float | None
    abs_rel_dynamic: float | None
    delta1: float | None
    rotation_error: float | None  # degrees, mean over frames, relative to frame 0
    centre_error: float | None  # RMSE after Sim(3), in the truth's unit
    centre_error_ratio: float | None  # centre error over the clip's median true depth
    point_distance: float | None  # mean over pixels, after Sim(3) of the centres, in the truth's unit
    point_distance_first: float | None  # the same, after alignment of the first camera and one median scale
    saliency_auc: float | None  # of the first pass, over pixels; of the motion by matches where these give the mask
    mask_jaccard: float | None  # of the mask of the second pass
    failure: str = ""


class _Scene(NamedTuple):
    """The truth of one clip."""

    clip: int
    truth: Truth
    points: Float[np.ndarray, "N 3"]  # of the pixels with a true depth


class _Setting(NamedTuple):
    """The settings of a second pass."""

    mask_source: MaskSource | Literal["pixels"] | None = None
    mask_pairs: int | None = None
    suppress: Suppress | None = None


def _assemble(passes: Passes, *, methods: tuple[str, ...]) -> list[Assembly]:
    return [assemble(passes, method=method) for method in methods]


def ladder(
    model: Model,
    truth: ClipTruth,
    *,
    methods: Sequence[str] = ABLATION,
    masks: Sequence[MaskSource] = ("mined", "true"),
    mask_pairs: Sequence[int] | None = None,
    suppress: Sequence[Suppress] = ("zero",),
    options: Options = Options(compute_dtype="float32"),
    batch_size: int = 4,
    known_cameras: bool = False,
    progress: Progress | None = None,
    **changes: Any,
) -> list[LadderRow]:
    """Score methods on clips of one shape; features and first pass are computed once per clip.

    Args:
        model: the network.
        truth: clips with exact truth, [S, ...] or [B, S, ...]; height and width are multiples of the patch size.
        methods: names of `ABLATION`. A method without a second pass has one row per clip, any other method one row for
            each combination of the three arguments that follow.
        masks: "mined" from the first pass by the Gram saliency, as in the papers; by "matches" too; or the "true"
            masks, an upper bound for any mining.
        mask_pairs: numbers of pairs in which the keys of dynamic tokens are suppressed; the model's own if None.
        suppress: ways to suppress them, in place of the methods' own.
        options: the other settings, such as `gram` or the threshold of mined masks.
        batch_size: number of clips that go through the network together.
        known_cameras: the network reads the true cameras.
        progress: called with the number of passes done and of all passes.
        changes: fields of `options` by name, such as `gram="dot"`.

    Returns:
        Rows in the order of clips, then mask, pairs, suppression and method; methods without a second pass come first.

    Raises:
        InputError: an unknown name, shapes that do not fit, or known cameras for a network that reads none. A
            prediction that cannot be scored is not an error: its row has the reason.
    """
    truth = batched_truth(truth)
    _check_choices(methods, masks, batch_size)
    masked = tuple(name for name in methods if find_method(name).needs_second_pass)
    plain = tuple(name for name in methods if name not in masked)
    pairs = (model.config.motion.mask_pairs,) if mask_pairs is None else mask_pairs
    settings = [_Setting(*values) for values in product(masks, pairs, suppress)] if masked else []
    witness = "matches" if "matches" in masks else "gram"
    options = options.changed(**changes)
    _check_options(options)
    options = options.changed(mask=witness)
    batches = list(_batches(len(truth.images), batch_size))
    total, steps = len(batches) * (1 + len(settings)), count(1)
    advance = (lambda: None) if progress is None else (lambda: progress(next(steps), total))
    execute = Execute()

    run = partial(run_passes, model.params, config=model.config, step=execute)

    rows: list[LadderRow] = []
    for clips, padded in batches:
        images = jax.device_put(truth.images[padded].astype(np.float32, copy=False))
        cameras = None
        if known_cameras:
            poses, intrinsics = jax.device_put((truth.camera_from_world[padded], truth.intrinsics[padded]))
            cameras = encode_pose(poses, intrinsics, truth.images.shape[2:4])
        batch = Clips(images, cameras=cameras)
        scenes = [_scene(int(clip), truth) for clip in clips]
        true_masks = jax.device_put(truth.dynamic_mask[padded])
        shared, by_setting = None, {}
        for setting in sorted(settings, key=lambda setting: setting.mask_source != "matches"):  # others share its pass
            own = options.changed(
                mask="matches" if setting.mask_source == "matches" else "gram",
                mask_pairs=setting.mask_pairs,
                suppress=setting.suppress,
            )
            passes = run(batch, options=own, masks=true_masks if setting.mask_source == "true" else None, shared=shared)
            shared = shared or passes
            pixels = _seen_motion(execute, passes, batch.images)
            by_setting[setting] = list(_scored(passes, masked, scenes, pixels, setting))
            advance()
        passes = run(batch, options=options.changed(method="vggt", mask="gram"), shared=shared)
        rows += _scored(passes, plain, scenes, _seen_motion(execute, passes, batch.images), _Setting())
        advance()
        rows += chain.from_iterable(by_setting[setting] for setting in settings)
    return sorted(rows, key=lambda row: row.clip)


def _check_choices(methods: Sequence[str], masks: Sequence[MaskSource], batch_size: int) -> None:
    if foreign := [method for method in methods if find_method(method) and method not in ABLATION]:
        raise InputError(f"methods has {foreign}, which mine their masks in another way; expected some of {ABLATION}")
    if unknown := [source for source in masks if source not in get_args(MaskSource)]:
        raise InputError(f"masks has {unknown}; expected 'mined', 'matches' or 'true'")
    if batch_size < 1:
        raise InputError(f"batch_size is {batch_size}; expected at least 1")


def score_result(result: Reconstruction, truth: ClipTruth, mask_source: Literal["mined", "pixels"]) -> LadderRow:
    """Return the scores of a result of any method whose frames are those of a clip with exact truth.

    Raises InputError for truth of another shape.
    """
    truth, motion = batched_truth(truth), result.motion if result.motion is not None else result.saliency
    if truth.depth.shape != (1, *result.depth.shape):
        raise InputError(f"the truth has depth of shape {truth.depth.shape[1:]}; expected {result.depth.shape}")
    pixels = result.dynamic_mask
    if motion is not None:
        pixels = np.asarray(upsample(jax.numpy.asarray(motion[None]), result.depth.shape[1:]))[0]
    fields = (result.depth, result.intrinsics, result.camera_from_world, result.dynamic_mask, pixels)
    return _row(_scene(0, truth), result.method, _Setting(mask_source if result.has_mask else None), *fields)


def _check_options(options: Options) -> None:
    """Raise InputError for options that are arguments of the ladder, or that it does not read."""
    for name in (
        "method",
        "mask",
        "mask_pairs",
        "suppress",
        "align_scale",
        "refine_mask",
        "refine_cameras",
        "consistent_depth",
    ):
        if getattr(options, name) != getattr(Options(), name):
            raise InputError(
                f"options have {name} {getattr(options, name)!r}; leave it out: methods, masks, mask_pairs and "
                "suppress are arguments of the ladder, and nothing is refined"
            )


def _seen_motion(execute: Execute, passes: Passes, images: Any) -> Float[np.ndarray, "B S H W"]:
    """Return what the mask was cut from: the motion by matches if there is one, else the Gram saliency."""
    if passes.motion is not None:
        return np.asarray(execute("motion", motion_pixels)(passes.motion, images))
    return np.asarray(execute("saliency", upsample)(passes.saliency, size=images.shape[2:4]))


def _batches(count: int, size: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the clips of each batch, and the same clips padded with the last clip to one size of batch."""
    size = min(size, count)
    for start in range(0, count, size):
        indices = np.arange(start, start + size)
        yield indices[indices < count], np.minimum(indices, count - 1)


def _scene(clip: int, truth: Truth) -> _Scene:
    own = truth.clip(clip)
    points = known_points(own.depth, own.intrinsics, own.camera_from_world, measured(own.depth))
    return _Scene(clip, own, points)


def _scored(
    passes: Passes,
    methods: tuple[str, ...],
    scenes: list[_Scene],
    motion: Float[np.ndarray, "B S H W"],
    setting: _Setting,
) -> Iterator[LadderRow]:
    mask = np.asarray(passes.dynamic_mask)
    join = Execute()("assemble", _assemble)
    read = passes._replace(features=None, motion=None, is_matched=None, matches=None)
    for method, assembly in zip(methods, join(read, methods=methods), strict=True):
        depth, intrinsics = np.asarray(assembly.depth), np.asarray(assembly.intrinsics)
        cameras = np.asarray(assembly.camera_from_world)
        for i, scene in enumerate(scenes):
            yield _row(scene, method, setting, depth[i], intrinsics[i], cameras[i], mask[i], motion[i])


def _row(
    scene: _Scene,
    method: str,
    setting: _Setting,
    depth: Float[np.ndarray, "S H W"],
    intrinsics: Float[np.ndarray, "S 3 3"],
    camera_from_world: Float[np.ndarray, "S 3 4"],
    mask: Bool[np.ndarray, "S H W"],
    motion: Float[np.ndarray, "S H W"],
) -> LadderRow:
    truth, failures = scene.truth, []

    def attempt(function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except InputError as error:
            failures.append(str(error))
            return None

    off_centre = attempt(centre_error, camera_from_world, truth.camera_from_world)
    known, dynamic = measured(truth.depth), truth.dynamic_mask
    points = attempt(known_points, depth, intrinsics, camera_from_world, known)

    def distance_after(align: Callable[[], Similarity]) -> float | None:
        return None if points is None else paired_distance(align().apply(points), scene.points).mean

    def all_cameras() -> Similarity:
        return umeyama_sim3(checked_centres(camera_from_world), checked_centres(truth.camera_from_world))

    def first_camera() -> Similarity:  # brings it to the true one, with points scaled as seen from it
        scale, pose, true_pose = median_scale(depth, truth.depth), camera_from_world[0], truth.camera_from_world[0]
        to_camera = Similarity(scale, pose[:, :3], scale * pose[:, 3])
        return Similarity(1, true_pose[:, :3], true_pose[:, 3]).inverse().after(to_camera)

    distance = float(np.median(truth.depth[known])) if known.any() else None
    return LadderRow(
        clip=scene.clip,
        method=method,
        **setting._asdict(),
        **(attempt(_depth_scores, depth, truth) or dict.fromkeys(_DEPTH_SCORES)),
        rotation_error=attempt(rotation_error, camera_from_world, truth.camera_from_world),
        centre_error=off_centre,
        centre_error_ratio=None if off_centre is None or distance is None else off_centre / distance,
        point_distance=None if off_centre is None else attempt(distance_after, all_cameras),
        point_distance_first=attempt(distance_after, first_camera),
        saliency_auc=attempt(auc, motion, dynamic) if dynamic.any() and not dynamic.all() else None,
        mask_jaccard=None if setting.mask_source is None else jaccard(mask, dynamic),
        failure="; ".join(dict.fromkeys(failures)),
    )


_DEPTH_SCORES = ("abs_rel", "abs_rel_static", "abs_rel_dynamic", "delta1")


def _depth_scores(depth: Float[np.ndarray, "S H W"], truth: Truth) -> dict[str, float | None]:
    scale, known = median_scale(depth, truth.depth), measured(truth.depth)
    whole = depth_errors(depth, truth.depth, scale=scale)

    def within(region: Bool[np.ndarray, "S H W"]) -> float | None:
        return depth_errors(depth, truth.depth, region, scale=scale).abs_rel if (region & known).any() else None

    values = (whole.abs_rel, within(~truth.dynamic_mask), within(truth.dynamic_mask), whole.delta1)
    return dict(zip(_DEPTH_SCORES, values, strict=True))
