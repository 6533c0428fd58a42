"""The two passes and the methods assembled from them: the stages of 4DVGGT-D as pure functions (arXiv 2605.12027)."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vggtjax.cameras import Cameras
from vggtjax.config import Gram, MotionConfig, Threshold, VGGTConfig, Witness
from vggtjax.errors import InputError
from vggtjax.method.adjusted_cameras import adjusted_cameras
from vggtjax.method.fusion import fuse_depth, replace_depth, scale_between
from vggtjax.method.mask import dynamic_tokens, mine_mask
from vggtjax.method.matched_mask import Mined, mine_matched_mask
from vggtjax.method.matches import Matches
from vggtjax.method.witnesses import Seen, Sometimes, Witnesses
from vggtjax.network.backbone import encode, patch_grid
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.frames import Frames
from vggtjax.network.layers import Params
from vggtjax.network.model import Predictions, predict
from vggtjax.network.pose import decode_pose
from vggtjax.network.precision import Compute
from vggtjax.network.suppression import Suppression
from vggtjax.network.track_head import Tracks
from vggtjax.options import CamerasFrom, Options, find_method

_Value = TypeVar("_Value")


class Passes(NamedTuple):
    """Both passes over clips, and the mask between them. `second` is None without a second pass."""

    first: Predictions
    second: Predictions | None
    saliency: Float[Array, "B S h w"]
    dynamic_mask: Bool[Array, "B S H W"]
    motion: Float[Array, "B S h w"] | None = None  # as in `Mined`
    is_matched: Bool[Array, "B S"] | None = None  # as in `Mined`
    matches: Matches | None = None  # of the first pass, where cameras are adjusted to them


class Assembly(NamedTuple):
    """A method's result: depth up to scale, its confidence, and the cameras."""

    depth: Float[Array, "B S H W"]
    confidence: Float[Array, "B S H W"]
    cameras: Cameras

    @property
    def camera_from_world(self) -> Float[Array, "B S 3 4"]:
        return self.cameras.camera_from_world

    @property
    def intrinsics(self) -> Float[Array, "B S 3 3"]:
        return self.cameras.intrinsics


def first_pass(
    params: Params,
    clips: ClipBatch,
    config: VGGTConfig,
    *,
    gram: Gram = "cosine",
    witness: Witness = "gram",
    motion: MotionConfig | None = None,
    exponents: Float[Array, " cues"] | None = None,
    outputs: tuple[str, ...] = ("camera", "depth"),
    query_points: Float[Array, "B Q 2"] | None = None,
    compute: Compute = Compute(),
) -> tuple[Predictions, Seen]:
    """Run the plain pass and mine the motion saliency inside it; with `query_points`, track them too.

    Predictions of padded frames are meaningless. `exponents` has one power per cue, applied before their product. With
    the `witness` "matches", what is seen has the matches too.
    """
    B, S = clips.images.shape[:2]
    grid = patch_grid(clips.images, config)
    witnesses = Witnesses(motion or config.motion, config.depth, grid, gram, witness, compute.frames)
    predictions = predict(
        params,
        clips,
        config,
        outputs=outputs if query_points is None else (*outputs, "tracks"),
        query_points=query_points,
        accumulator=None if compute.frames.counted(S) == 1 else witnesses.accumulator,
        compute=compute,
    )
    return predictions._replace(cue_sums=None), witnesses.seen(predictions.cue_sums, B, S, exponents)


def either_pass(
    params: Params,
    clips: ClipBatch,
    dynamic_mask: Bool[Array, "B S H W"],
    is_first: Bool[Array, ""],
    config: VGGTConfig,
    *,
    gram: Gram = "cosine",
    witness: Witness = "gram",
    suppression: Suppression = Suppression(),
    outputs: tuple[str, ...] = ("camera", "depth"),
    compute: Compute = Compute(),
) -> tuple[Predictions, Seen]:
    """Run the first pass or the second: one program serves both, and is compiled once.

    Args:
        params: the model's parameter tree.
        clips: images, patch tokens and numbers of real frames.
        dynamic_mask: dynamic pixels; none for the first pass.
        is_first: whether this is the first pass, in which motion cues are added up. What the second pass sees is
            meaningless.
        config: the model's configuration.
        gram: similarity of the motion cues.
        witness: as for `first_pass`.
        suppression: how keys of dynamic tokens are suppressed, and in which pairs; 0 pairs for the first pass.
        outputs: what to predict, as for `forward`.
        compute: as for `predict`.
    """
    B, S = clips.images.shape[:2]
    witnesses = Witnesses(config.motion, config.depth, patch_grid(clips.images, config), gram, witness, compute.frames)
    masking = dataclasses.replace(suppression, dynamic_tokens=dynamic_tokens(dynamic_mask, config.patch_size))
    options = {"outputs": outputs, "suppression": masking, "compute": compute}
    accumulator = Sometimes(witnesses.accumulator, is_first)
    predictions = predict(params, clips, config, accumulator=accumulator, **options)
    return predictions._replace(cue_sums=None), witnesses.seen(predictions.cue_sums, B, S)


def mine(
    seen: Seen,
    first: Predictions,
    clips: ClipBatch,
    *,
    clusters: int,
    threshold: Threshold,
    smooth_frames: int = 1,
    frames: Frames = Frames(),
) -> Mined:
    """Return the dynamic pixels, by matches if there are any, and what matches say.

    Args:
        seen: what the first pass sees of motion.
        first: its predictions, with camera and depth where there are matches.
        clips: images and patch tokens.
        clusters: as for `mine_mask`, and so are `threshold`, `smooth_frames` and `frames`.
        threshold: of the Gram saliency.
        smooth_frames: of the Gram saliency.
        frames: where the frames are.
    """
    images = clips.images
    how = {"clusters": clusters, "threshold": threshold, "smooth_frames": smooth_frames, "frames": frames}
    mask = mine_mask(seen.saliency, _present(clips.patch_tokens), (images.shape[2], images.shape[3]), **how)
    if seen.matches is None:
        return Mined(mask)
    depth, pose_encoding = _present(first.depth), _present(first.pose_encoding)
    return mine_matched_mask(seen.matches, mask, seen.saliency, images, depth, pose_encoding, frames=frames)


def second_pass(
    params: Params,
    clips: ClipBatch,
    dynamic_mask: Bool[Array, "B S H W"] | Float[Array, "B S H W"],
    config: VGGTConfig,
    *,
    plain: Predictions | None = None,
    suppression: Suppression = Suppression(),
    outputs: tuple[str, ...] = ("camera", "depth"),
    compute: Compute = Compute(),
) -> Predictions:
    """Run the mask-aware pass: the keys of dynamic tokens are suppressed in the first pairs of blocks.

    If the mask is boolean, no pixel of the batch is dynamic and `plain` has all outputs, the predictions of `plain` are
    returned and nothing is computed. Predictions of padded frames are meaningless.

    Args:
        params: the model's parameter tree.
        clips: images, patch tokens and numbers of real frames.
        dynamic_mask: dynamic pixels, or their shares in [0, 1]. They become the dynamic tokens of the suppression.
        config: the model's configuration.
        plain: predictions of the first pass.
        suppression: how keys are suppressed, and in which pairs.
        outputs: what to predict, as for `forward`.
        compute: as for `predict`.
    """

    def masked() -> Predictions:
        tokens = dynamic_tokens(dynamic_mask, config.patch_size)
        masking = dataclasses.replace(suppression, dynamic_tokens=tokens)
        return predict(params, clips, config, suppression=masking, outputs=outputs, compute=compute)

    unchanged = None if plain is None else only(plain, outputs)
    if unchanged is None or dynamic_mask.dtype != bool:
        return masked()
    return jax.lax.cond(compute.frames.any(dynamic_mask.any()), masked, lambda: unchanged)


def only(predictions: Predictions, outputs: tuple[str, ...]) -> Predictions | None:
    """Return the predictions of these outputs alone; None if there is one that was not predicted."""
    fields = {"camera": ("pose_encoding",), "depth": ("depth", "depth_confidence")}
    wanted = {name: getattr(predictions, name, None) for output in outputs for name in fields.get(output, (output,))}
    return None if any(value is None for value in wanted.values()) else Predictions(**wanted)


def track_from(
    params: Params,
    clips: ClipBatch,
    query_points: Float[Array, "B Q 2"],
    frame: Int[Array, ""],
    config: VGGTConfig,
    *,
    compute: Compute = Compute(),
) -> Tracks:
    """Track points of any frame: the clip is rolled so that the frame comes first, and its tracks are rolled back.

    Args:
        params: the model's parameter tree.
        clips: images and patch tokens of the clips, in their order; all frames are real.
        query_points: x, y in pixels of the frame.
        frame: its index (can be traced: one compilation serves all frames with equal numbers of points).
        config: the model's configuration.
        compute: as for `predict`.
    """
    frames = compute.frames
    rolled = jax.tree.map(lambda x: frames.roll(x, -frame), clips)
    predictions = predict(params, rolled, config, outputs=("tracks",), query_points=query_points, compute=compute)
    tracks = (predictions.tracks, predictions.track_visibility, predictions.track_confidence)
    return Tracks(*(frames.roll(_present(value), frame) for value in tracks))


def motion_saliency(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    gram: Gram = "cosine",
    motion: MotionConfig | None = None,
) -> Float[Array, "B S h w"]:
    """Return the motion saliency of each patch, in [0, 1]: the product of the table's Gram maps.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1].
        config: the model's configuration.
        gram: "cosine" (rows of q and k normalised per head, 4DVGGT-D) or "dot" (VGGT4D).
        motion: the table of cues; the configuration's own if None.
    """
    return first_pass(params, ClipBatch(images), config, gram=gram, motion=motion, outputs=())[1].saliency


def run_passes(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    options: Options = Options(),
    motion: MotionConfig | None = None,
    clusters: int | None = None,
    second: tuple[str, ...] | None = None,
    **changes: Any,
) -> Passes:
    """Run both passes once with shared backbone features, for `assemble`.

    The passes of the default options serve all methods of `LADDER`; "vggt4d" and "4dvggt-m" need their own.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1]; any batch and any number of frames.
        config: the model's configuration.
        options: how motion is mined and keys are suppressed; masks are not refined.
        motion: the table of cues, with the number of pairs and the threshold unless the options have one; the
            configuration's own if None.
        clusters: number of clusters that the saliency is averaged in, 0 for none; the method's own if None.
        second: outputs of the second pass, () for no second pass; the outputs that the method needs if None.
        changes: fields of `options` by name, such as `gram="dot"`; `mask_pairs` can be traced.
    """
    given: Any = changes.pop("mask_pairs", options.mask_pairs)  # not in the options: the number can be traced
    recommended = motion or config.motion
    mask_pairs = recommended.masked_pairs(given)
    options = options.changed(**changes)
    method, compute = options.row, Compute.of(options)
    if second is None:
        second = method.second_outputs(options.align_scale) if method.needs_second_pass else ()
    patch_tokens = encode(params, images, config, compute_dtype=compute.compute_dtype)
    clips = ClipBatch(images, patch_tokens)
    mining = {"gram": method.gram, "witness": options.witness, "motion": motion, "compute": compute}
    first, seen = first_pass(params, clips, config, **mining)
    matches = seen.matches if options.cameras == "adjusted" else None
    mined = mine(
        seen if method.mask == "matches" else Seen(seen.saliency),
        first,
        clips,
        clusters=method.clusters if clusters is None else clusters,
        threshold=recommended.cut_by(options.threshold, method.threshold),
        smooth_frames=options.smooth_frames,
    )
    if not second:
        return Passes(first, None, seen.saliency, *mined, matches)
    suppression = Suppression(suppress=method.suppress, mask_pairs=mask_pairs)
    masking = {"plain": first, "suppression": suppression, "outputs": second, "compute": compute}
    second_one = second_pass(params, clips, mined.dynamic_mask, config, **masking)
    return Passes(first, second_one, seen.saliency, *mined, matches)


def assemble(
    passes: Passes,
    method: str = "4dvggt-d",
    *,
    align_scale: bool = False,
    cameras: CamerasFrom = "predicted",
    frames: Frames = Frames(),
) -> Assembly:
    """Return a method's depth, confidence and cameras from two passes; the methods of `LADDER` share one run of them.

    Args:
        passes: of `run_passes` with this method's options; passes of another method give a wrong result, not an error.
        method: a name of `METHODS`.
        align_scale: scale the second pass (depth and camera translations) by the median depth ratio over static
            pixels before it is used. Not in the paper.
        cameras: adjust the cameras to the matches of static pixels, which the passes must have. Not in the paper.
        frames: where the frames of the passes are.
    """
    row = find_method(method)
    if passes.second is None and row.needs_second_pass:
        raise InputError(f"method {method!r} needs the second pass, which was not run")
    first, second = passes.first, passes.second or passes.first
    scale = jnp.ones(passes.dynamic_mask.shape[0])
    if align_scale and passes.second is not None:
        scale = scale_between(_present(first.depth), _present(second.depth), passes.dynamic_mask, frames)

    def of_first() -> tuple[Array, Array]:
        return _present(first.depth), _present(first.depth_confidence)

    def of_second() -> tuple[Array, Array]:
        return _present(second.depth) * scale[:, None, None, None], _present(second.depth_confidence)

    depth, confidence = {
        "first": of_first,
        "second": of_second,
        "replaced": lambda: replace_depth(*of_first(), *of_second(), passes.dynamic_mask),
        "fused": lambda: fuse_depth(*of_first(), *of_second(), passes.dynamic_mask),
    }[row.depth]()
    size = (depth.shape[2], depth.shape[3])
    extrinsics, intrinsics = decode_pose(_present(second.pose_encoding), size)
    of_pass = {
        "first": Cameras(*decode_pose(_present(first.pose_encoding), size)),
        "second": Cameras(extrinsics.at[..., 3].multiply(scale[:, None, None]), intrinsics),
    }
    chosen = Cameras(of_pass[row.extrinsics].camera_from_world, of_pass[row.intrinsics].intrinsics)
    assembly = Assembly(depth, confidence, chosen)
    return assembly if cameras == "predicted" else with_adjusted_cameras(assembly, passes, frames)


def with_adjusted_cameras(assembly: Assembly, passes: Passes, frames: Frames = Frames()) -> Assembly:
    """Return the assembly with cameras for which static pixels are seen where they are matched. Not in the papers."""
    if passes.matches is None:
        raise InputError("the passes have no matches to adjust cameras to; run them with cameras='adjusted'")
    grid = (passes.saliency.shape[2], passes.saliency.shape[3])
    given = (assembly.cameras, assembly.depth, passes.matches, passes.dynamic_mask, grid)
    return assembly._replace(cameras=adjusted_cameras(*given, frames=frames))


def _present(value: _Value | None) -> _Value:
    if value is None:
        raise InputError("the passes lack depth or cameras; run them with outputs=('camera', 'depth')")
    return value
