"""The steps of the two passes: each a pure function of arrays, with static keywords (4DVGGT-D, arXiv 2605.12027)."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.clips.still import same_picture
from vggtjax.config import Gram, MotionConfig, Suppress, Threshold, VGGTConfig, Witness
from vggtjax.errors import InputError
from vggtjax.method.mask import dynamic_tokens, mine_mask
from vggtjax.method.matching.matched_mask import MotionMask, mine_matched_mask
from vggtjax.method.matching.matches import Matches
from vggtjax.method.matching.witnesses import Evidence, Witnesses
from vggtjax.method.soft_mask import SoftMasking, soft_pixels
from vggtjax.network.backbone import ClipBatch, Features, patch_grid
from vggtjax.network.heads.track_head import Tracks
from vggtjax.network.kernels.frames import Frames, with_frames
from vggtjax.network.layers import Params
from vggtjax.network.model import FIELDS, Predictions, predict
from vggtjax.network.precision import Compute
from vggtjax.network.suppression import Suppression

_Value = TypeVar("_Value")


class Passes(NamedTuple):
    """Both passes over clips, and the mask between them.

    `second` is None without a second pass, and equal to `first` where nothing moves.
    """

    first: Predictions
    second: Predictions | None
    saliency: Float[Array, "B S h w"]
    dynamic_mask: Bool[Array, "B S H W"] | Float[Array, "B S H W"]
    motion: Float[Array, "B S h w"] | None = None  # as in `MotionMask`
    is_matched: Bool[Array, "B S"] | None = None  # as in `MotionMask`
    matches: Matches | None = None  # of the first pass, where it gathered them
    features: Features | None = None  # of the backbone, which both passes share
    tracks: dict[int, Tracks] | None = None  # by the frame of their query points


def first_pass(
    params: Params,
    clips: ClipBatch,
    query_points: Float[Array, "B Q 2"] | None = None,
    exponents: Float[Array, " cues"] | None = None,
    *,
    config: VGGTConfig,
    gram: Gram = "cosine",
    witness: Witness = "gram",
    outputs: tuple[str, ...] = ("camera", "depth"),
    compute: Compute = Compute(),
) -> tuple[Predictions, Evidence]:
    """Run the plain pass and mine the motion saliency inside it; with `query_points`, track them too.

    Predictions of padded frames are meaningless. `exponents` has one power per cue, applied before their product. With
    the `witness` "matches", what is seen has the matches too.
    """
    B, S = clips.images.shape[:2]
    grid = patch_grid(clips.images, config)
    witnesses = Witnesses(config.motion, config.depth, grid, gram, witness, compute.frames, compute.precision)
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


def mine(
    seen: Evidence,
    first: Predictions | None,
    clips: ClipBatch,
    *,
    clusters: int,
    threshold: Threshold,
    smooth_frames: int = 1,
    frames: Frames = Frames(),
) -> MotionMask:
    """Return the dynamic pixels, by matches if there are any, and what matches say; none where all frames are equal.

    Args:
        seen: what the first pass sees of motion.
        first: its predictions, which are read where there are matches.
        clips: images and features.
        clusters: as for `mine_mask`, and so is `smooth_frames`.
        threshold: of the Gram saliency.
        smooth_frames: of the Gram saliency.
        frames: where the frames are: every device mines all of them. Those after `frames.count` are not read, and have
            no dynamic pixels.
    """
    S = clips.images.shape[1]
    seen, first, clips = frames.whole((seen, first, clips._replace(frame_count=None)))
    images, size = clips.images, (clips.images.shape[2], clips.images.shape[3])
    how = {"clusters": clusters, "threshold": threshold, "smooth_frames": smooth_frames}
    mined = MotionMask(mine_mask(seen.saliency, present(clips.features).patch_tokens, size, **how))
    if seen.matches is not None:
        first = present(first)
        of_first = (present(first.depth), present(first.pose_encoding))
        mined = mine_matched_mask(seen.matches, mined.dynamic_mask, seen.saliency, images, *of_first)
    moves = ~are_equal(images)[:, None, None, None]
    return with_frames(mined._replace(dynamic_mask=mined.dynamic_mask & moves), S)


def mine_soft(
    saliency: Float[Array, "B S h w"],
    images: Float[Array, "B S H W 3"],
    masking: SoftMasking,
    *,
    threshold: Threshold,
    frames: Frames = Frames(),
) -> Float[Array, "B S H W"]:
    """Return the dynamic share of every pixel by the Gram saliency, with gradients; 0 where all frames are equal.

    Frames after `frames.count` are not read, and have shares of 0. All frames are on one device.
    """
    S = images.shape[1]
    saliency, images = frames.whole((saliency, images))
    shares = soft_pixels(saliency, masking, size=(images.shape[2], images.shape[3]), threshold=threshold)
    return with_frames(jnp.where(are_equal(images)[:, None, None, None], 0, shares), S)


def are_equal(images: Float[Array, "B S H W 3"]) -> Bool[Array, " B"]:
    """Return the clips whose frames are all one picture, up to the noise of a codec."""
    return same_picture(images, images[:, :1]).all(axis=1)


def second_pass(
    params: Params,
    clips: ClipBatch,
    dynamic_mask: Bool[Array, "B S H W"] | Float[Array, "B S H W"],
    plain: Predictions | None = None,
    mask_pairs: int | Int[Array, ""] | None = None,
    strength: Float[Array, " depth"] | None = None,
    *,
    config: VGGTConfig,
    suppress: Suppress = "zero",
    outputs: tuple[str, ...] = ("camera", "depth"),
    compute: Compute = Compute(),
) -> Predictions:
    """Run the mask-aware pass: the keys of dynamic tokens are suppressed in the first pairs of blocks.

    If the mask is boolean, no pixel of the batch is dynamic and `plain` has all outputs, the predictions of `plain` are
    returned and nothing is computed. Predictions of padded frames are meaningless.

    Args:
        params: the model's parameter tree.
        clips: images, features, numbers of real frames, known cameras.
        dynamic_mask: dynamic pixels, or their shares in [0, 1]. They become the dynamic tokens of the suppression.
        plain: predictions of the first pass.
        mask_pairs, strength: in which pairs keys are suppressed, or how much in each; see `Suppression`.
        config: the model's configuration.
        suppress: how keys are suppressed.
        outputs: what to predict, as for `forward`.
        compute: as for `predict`.
    """

    def masked() -> Predictions:
        tokens = dynamic_tokens(dynamic_mask, config.patch_size)
        masking = Suppression(tokens, suppress, mask_pairs, strength)
        return predict(params, clips, config, suppression=masking, outputs=outputs, compute=compute)

    unchanged = None if plain is None else only(plain, outputs)
    if unchanged is None or dynamic_mask.dtype != bool:
        return masked()
    return jax.lax.cond(compute.frames.any(dynamic_mask.any()), masked, lambda: unchanged)


def only(predictions: Predictions, outputs: tuple[str, ...]) -> Predictions | None:
    """Return the predictions of these outputs alone; None if there is one that was not predicted."""
    wanted = {field: getattr(predictions, field) for output in outputs for field in FIELDS[output]}
    return None if any(value is None for value in wanted.values()) else Predictions(**wanted)


def track_from(
    params: Params,
    clips: ClipBatch,
    query_points: Float[Array, "B Q 2"],
    frame: Int[Array, ""] | Int[np.ndarray, ""],
    *,
    config: VGGTConfig,
    compute: Compute = Compute(),
) -> Tracks:
    """Track points of any frame: the clip is rolled so that the frame comes first, and its tracks are rolled back.

    Args:
        params: the model's parameter tree.
        clips: images and features of the clips, in their order; all frames are real.
        query_points: x, y in pixels of the frame.
        frame: its index (can be traced: one compilation serves all frames with equal numbers of points).
        config: the model's configuration.
        compute: as for `predict`.
    """
    rolled = jax.tree.map(lambda x: jnp.roll(x, -frame, axis=1), clips)
    predictions = predict(params, rolled, config, outputs=("tracks",), query_points=query_points, compute=compute)
    tracks = (predictions.tracks, predictions.track_visibility, predictions.track_confidence)
    return Tracks(*(jnp.roll(present(value), frame, axis=1) for value in tracks))


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
    config = config if motion is None else dataclasses.replace(config, motion=motion)
    return first_pass(params, ClipBatch(images), config=config, gram=gram, outputs=())[1].saliency


def present(value: _Value | None) -> _Value:
    """Return what a pass predicted. Raises InputError where it did not."""
    if value is None:
        raise InputError("the passes lack depth or cameras; run them with outputs=('camera', 'depth')")
    return value
