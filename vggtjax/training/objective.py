"""The training objective: VGGT's losses, and terms that teach geometry across frames from little data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.config import Suppress, VGGTConfig
from vggtjax.network.aggregator import Aggregator
from vggtjax.network.backbone import ClipBatch, encode, patch_grid
from vggtjax.network.heads.camera_encoder import encode_cameras
from vggtjax.network.heads.camera_head import predict_pose
from vggtjax.network.heads.dpt_head import DENSE_HEADS, predict_dense, project_tap
from vggtjax.network.heads.pose import encode_pose, quaternion_to_matrix
from vggtjax.network.layers import LayerNorm, Params
from vggtjax.network.model import HEADS, tap_patches
from vggtjax.network.precision import Compute, full_precision
from vggtjax.network.suppression import Suppression
from vggtjax.storage.json_values import Natural, NotNegative, Share, check_fields
from vggtjax.training.matching import MatchLoss
from vggtjax.training.truth import Clips, MatchCounts, Matches, Targets, match_counts, matches, targets

PATCH_PROBE = 6  # position in the first frame (2), logarithm of depth (1), point in the first camera's frame (3)
CAMERA_PROBE = 7 + 10  # translation (3), quaternion (4), moments of the flow from the first frame
CONFIDENCE = 0.2  # weight of the logarithm of confidence, as in VGGT
_NEAR = 0.1  # in mean distances: nearer points count as ones so near where errors are relative


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("clips", "regions", "pairs"),
    meta_fields=("suppress", "known_cameras"),
)
@dataclass(frozen=True)
class Batch:
    """The clips of a step, and the random regions in which their keys are suppressed: a pytree.

    Attributes:
        clips: the clips and what is read of their truth.
        regions: pixels of suppressed patches; None for no suppression in any clip.
        pairs: share of the pairs of blocks, from the first, that suppress keys, in (0, 1]; the same for all clips.
        suppress: how keys are suppressed; static under jit.
        known_cameras: whether the network reads the true cameras; static under jit.
    """

    clips: Clips
    regions: Bool[Array, "B S H W"] | None = None
    pairs: Float[Array, " B"] | None = None
    suppress: Suppress = "zero"
    known_cameras: bool = False

    def suppression(self, config: VGGTConfig) -> Suppression:
        """Return the suppression of the network's keys: a patch is suppressed if its middle pixel is."""
        if self.regions is None or self.pairs is None:
            return Suppression()
        middle = slice(config.patch_size // 2, None, config.patch_size)
        pairs = jnp.ceil(self.pairs[0] * config.depth).astype(jnp.int32)
        return Suppression(self.regions[:, :, middle, middle], self.suppress, pairs)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms; terms of weight 0 are not part of the loss.

    Attributes:
        translation, rotation, field_of_view: L1 or Huber distance of the pose encoding's parts.
        huber: half width of the quadratic zone of the camera loss; 0 for L1.
        depth, points: confidence-weighted L1 of the dense heads; `gradient` is the share of the gradient term.
        relative: power of the inverse depth by which dense errors are weighted: 0 for VGGT's loss, 1 for relative ones.
        match: cross-entropy of attention in `match_layers` against true matches.
        probe: linear read-outs of the tapped tokens (positions, depths, points, poses), used in training only.
        moments: linear read-outs of the camera tokens: means of the flow that determine the camera's motion.
    """

    translation: NotNegative = 1.0
    rotation: NotNegative = 5.0
    field_of_view: NotNegative = 1.0
    huber: NotNegative = 0.0
    depth: NotNegative = 1.0
    points: NotNegative = 1.0
    gradient: NotNegative = 1.0
    relative: Share = 0.0
    match: NotNegative = 0.0
    match_layers: tuple[Natural, ...] = (1, 2, 3)
    probe: NotNegative = 0.0
    moments: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "losses")

    @property
    def dense(self) -> tuple[str, ...]:
        """The dense heads that have a loss: those with a field here, above 0."""
        return tuple(name for name in DENSE_HEADS if getattr(self, name, 0))


def init_probes(seed: int, config: VGGTConfig) -> Params:
    """Return the parameters of the linear read-outs of the taps, all 0."""
    E, taps = config.tap_dim, len(config.taps)
    widths = {"patch": PATCH_PROBE, "camera": CAMERA_PROBE}
    return {name: {"kernel": jnp.zeros((taps, E, F)), "bias": jnp.zeros((taps, F))} for name, F in widths.items()}


@full_precision()
def objective(
    trained: Params,
    batch: Batch,
    config: VGGTConfig,
    weights: LossWeights,
    *,
    compute_dtype: str = "float32",
    remat: bool = False,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Return the loss of a batch of clips, and the metrics to log.

    `trained` holds the model's parameters as "model" and those of `init_probes` as "probes"; `config` and `weights` are
    static. `compute_dtype` is that of the blocks' matrix products; with `remat` the activations of encoder, aggregator
    and dense heads are computed again in the backward pass.
    """
    model, probes = trained["model"], trained["probes"]
    clips = batch.clips
    images = clips.images
    grid = patch_grid(images, config)
    truth = targets(clips)
    paired = matches(clips, config.patch_size)
    counts = match_counts(paired)
    matching = MatchLoss(paired, counts, weights.match_layers, config.depth) if weights.match else None

    def capture(slot: int):
        @jax.checkpoint  # otherwise the scan stores this in every layer
        def captured(tokens: Float[Array, "B S T E"]) -> dict[str, Array]:
            patches = tap_patches(model, tokens, config)
            outputs = {name: project_tap(model[HEADS[name]], patches, slot, config) for name in weights.dense}
            if weights.probe or weights.moments:
                outputs |= {
                    "patch_probe": _probe(probes["patch"], slot, patches),
                    "camera_probe": _probe(probes["camera"], slot, tokens[:, :, 0]),
                }
            return outputs

        return captured

    captures = [capture(slot) for slot in range(len(config.taps))]
    compute = Compute(compute_dtype, reference="first")  # the targets are in its camera
    given = None
    if batch.known_cameras:
        H, W = images.shape[2:4]
        cameras = encode_pose(clips.camera_from_world, clips.intrinsics, (H, W))
        given = ClipBatch(images, cameras=cameras)

    def network(model: Params):
        known = None if given is None else encode_cameras(model, given, config, compute_dtype=compute_dtype)
        features = encode(model, images, config, compute_dtype=compute_dtype)
        settings = {"accumulator": matching, "suppression": batch.suppression(config), "compute": compute}
        return Aggregator(config).apply(
            {"params": model["aggregator"]}, features, grid, captures, camera_tokens=known, **settings
        )

    made: Any = (jax.checkpoint(network) if remat else network)(model)
    camera_tokens, taps, sums = made
    pose = predict_pose(model, camera_tokens, config, compute_dtype=compute_dtype)
    terms = _camera_terms(pose, truth.pose_encoding, weights)
    metrics = _camera_metrics(pose, truth.pose_encoding)
    goals = {"depth": truth.depth[..., None], "points": truth.points}
    for name in weights.dense:
        predict = jax.checkpoint(predict_dense, static_argnums=(2, 3, 4)) if remat else predict_dense
        values, confidence = predict(model[HEADS[name]], [tap[name] for tap in taps], config, grid, name)
        weight = truth.known / jnp.maximum(truth.depth, _NEAR) ** weights.relative
        loss = dense_loss(values, confidence, goals[name], weights.gradient, weight)
        terms[name] = getattr(weights, name) * loss
        if name == "depth":
            metrics["depth_error"] = _depth_error(values[..., 0], truth)
            metrics["confidence"] = confidence.mean()
    if weights.match:
        terms["match"] = weights.match * sums.loss
        metrics["match_accuracy"] = sums.accuracy
    if weights.probe or weights.moments:
        probe_terms = _probe_terms(taps, truth, paired, counts, config.patch_size)
        metrics |= {f"probe_{name}": value for name, value in probe_terms.items()}
        moments = probe_terms.pop("moments")
        if weights.moments:
            terms["moments"] = weights.moments * moments
        if weights.probe:
            terms["probe"] = weights.probe * sum(probe_terms.values(), start=jnp.zeros(()))
    loss = sum(terms.values(), start=jnp.zeros(()))
    return loss, {"loss": loss} | {f"loss_{name}": value for name, value in terms.items()} | metrics


def dense_loss(
    values: Float[Array, "B S H W V"],
    confidence: Float[Array, "B S H W"],
    truth: Float[Array, "B S H W V"],
    gradient: float,
    weight: Float[Array, "B S H W"],
) -> Float[Array, ""]:
    """Return VGGT's dense loss: the error weighted by confidence, minus its logarithm, and that of image gradients.

    Errors are multiplied by `weight`; pixels with a weight of 0 have no part in the loss.
    """
    known = weight > 0
    error = jnp.linalg.norm(values - truth, axis=-1) if values.shape[-1] > 1 else jnp.abs(values - truth)[..., 0]
    loss = (confidence * weight * error - CONFIDENCE * jnp.log(confidence)).mean(where=known)
    for axis in (2, 3) if gradient else ():
        step = jnp.diff(values, axis=axis) - jnp.diff(truth, axis=axis)
        last, first = (jax.lax.slice_in_dim(x, 1, None, axis=axis) for x in (weight * confidence, known))
        both = first & jax.lax.slice_in_dim(known, None, -1, axis=axis)
        loss = loss + gradient * (last * jnp.abs(step).mean(axis=-1)).mean(where=both)
    return loss


def _camera_terms(pose: Array, truth: Array, weights: LossWeights) -> dict[str, Array]:
    error = jnp.abs(pose - truth)
    if weights.huber:
        error = jnp.where(error < weights.huber, error**2 / (2 * weights.huber), error - weights.huber / 2)
    parts = {"translation": np.s_[:3], "rotation": np.s_[3:7], "field_of_view": np.s_[7:]}
    return {name: getattr(weights, name) * error[..., part].sum(axis=-1).mean() for name, part in parts.items()}


def _camera_metrics(pose: Array, truth: Array) -> dict[str, Array]:
    """Return errors against the truth, and the errors of a camera without motion, for comparison."""
    rotation, right = (quaternion_to_matrix(x[:, 1:, 3:7]) for x in (pose, truth))
    relative = rotation @ quaternion_to_matrix(pose[:, :1, 3:7]).swapaxes(-1, -2)
    centre = -jnp.einsum("bsji,bsj->bsi", rotation, pose[:, 1:, :3])
    right_centre = -jnp.einsum("bsji,bsj->bsi", right, truth[:, 1:, :3])
    return {
        "rotation_error": _angle(relative, right),
        "rotation_identity": _angle(jnp.broadcast_to(jnp.eye(3), right.shape), right),
        "centre_error": jnp.linalg.norm(centre - right_centre, axis=-1).mean(),
        "centre_identity": jnp.linalg.norm(right_centre, axis=-1).mean(),
    }


def _angle(a: Float[Array, "B S 3 3"], b: Float[Array, "B S 3 3"]) -> Float[Array, ""]:
    """Return the mean angle between rotations, in degrees."""
    chord = jnp.sqrt(jnp.sum((a - b) ** 2, axis=(-1, -2)))  # 2 sqrt(2) sin(angle / 2)
    return jnp.rad2deg(2 * jnp.arcsin(jnp.clip(chord / 8**0.5, 0, 1))).mean()


def _depth_error(depth: Float[Array, "B S H W"], truth: Targets) -> Float[Array, ""]:
    """Return the mean absolute relative error after alignment of every clip's medians (of each second pixel)."""
    depth, right = jnp.clip(depth, 1e-6, 1e6), jnp.where(truth.known, truth.depth, jnp.nan)
    few = np.s_[:, :, ::2, ::2]  # sorting all pixels would take a hundredth of a step
    ratio = (jnp.log(right[few]) - jnp.log(depth[few])).reshape(depth.shape[0], -1)
    scale = jnp.exp(jnp.nanmedian(ratio, axis=-1))[:, None, None, None]
    return jnp.nanmean(jnp.abs(scale * depth - right) / right)


def _probe(params: Params, slot: int, tokens: Float[Array, "... E"]) -> Float[Array, "... F"]:
    normed: Any = LayerNorm(use_bias=False, use_scale=False).apply({}, tokens)
    bias = params["bias"][slot].reshape((1,) * (tokens.ndim - 1) + (-1,))
    return jnp.einsum("...e,ef->...f", normed, params["kernel"][slot]) + bias


def _probe_terms(taps, truth: Targets, paired: Matches, counts: MatchCounts, patch_size: int) -> dict[str, Array]:
    B, S = truth.depth.shape[:2]
    middle = slice(patch_size // 2, None, patch_size)
    known = truth.known[:, :, middle, middle].reshape(B, S, -1)
    depth = jnp.log(jnp.where(known, truth.depth[:, :, middle, middle].reshape(B, S, -1), 1))
    points = truth.points[:, :, middle, middle].reshape(B, S, -1, 3)
    position = paired.position[:, :, 0]  # [B, R, P, 2]
    visible = paired.visible[:, :, 0][..., None]
    own = paired.position[:, :1, 0]  # of the first frame's patches in the first frame: the patch centres
    moments, enough = _flow_moments(position - own, own, jnp.exp(-depth), visible)
    terms: dict[str, Array] = {name: jnp.zeros(()) for name in ("position", "depth", "points", "camera", "moments")}
    for tap in taps:
        patch, camera = tap["patch_probe"], tap["camera_probe"]
        error = jnp.abs(patch[..., :2] - position) * visible
        terms["position"] += error.sum() / jnp.where(counts.first > 0, 2 * counts.first, 1)
        terms["depth"] += jnp.abs(patch[..., 2] - depth).mean(where=known)
        terms["points"] += jnp.abs(patch[..., 3:] - points).mean(axis=-1).mean(where=known)
        error = jnp.abs(camera[..., :7] - truth.pose_encoding[..., :7])
        terms["camera"] += error[..., :3].mean() + 5 * error[..., 3:].mean()
        terms["moments"] += (jnp.abs(camera[..., 7:] - moments).mean(axis=-1) * enough).mean()
    return {name: value / len(taps) for name, value in terms.items()}


def _flow_moments(
    flow: Float[Array, "B S P 2"],
    position: Float[Array, "B 1 P 2"],
    inverse_depth: Float[Array, "B S P"],
    visible: Bool[Array, "B S P 1"],
) -> tuple[Float[Array, "B S 10"], Bool[Array, "B S"]]:
    """Return means over visible patches that separate a camera's rotation from its translation; valid from 3 patches.

    To first order the flow of a static scene is w A t + B r: linear in translation t and rotation r, with inverse depth
    w and matrices A, B of the position alone (Longuet-Higgins and Prazdny 1980). Its normal equations consist of means
    of products of flow, inverse depth and position. The ten means are those of lowest order: the flow, the flow times
    inverse depth, the flow times position, inverse depth and its square. In the mean flow alone, rotation and
    translation can cancel. Patches on moving objects are included.
    """
    w = jnp.minimum(inverse_depth, 4.0)[..., None]
    factors = jnp.concatenate([jnp.ones_like(w), w, jnp.broadcast_to(position, flow.shape)], axis=-1)  # [B, S, P, 4]
    products = (flow[..., None, :] * factors[..., None]).reshape(*w.shape[:3], 8)
    values = jnp.concatenate([products, w, w**2], axis=-1)
    count = visible.sum(axis=(2, 3))
    return (values * visible).sum(axis=2) / jnp.maximum(count, 1)[..., None], count >= 3
