"""The network as one pure function: images and patch tokens -> pose encoding, depth, points, tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax.core.meta import unbox
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import Suppress, VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.aggregator import Accumulator, Aggregator, identity
from vggtjax.network.backbone import Backbone, ClipBatch, Features, encode, patch_grid
from vggtjax.network.given import as_array, as_images, check_floats
from vggtjax.network.heads.camera_encoder import CameraEncoder, encode_cameras
from vggtjax.network.heads.camera_head import camera_head, predict_pose
from vggtjax.network.heads.dpt_head import DENSE_HEADS, DenseHead, predict_dense, project_tap
from vggtjax.network.heads.pose import POSE_SIZE
from vggtjax.network.heads.ray_head import RayHead, predict_rays
from vggtjax.network.heads.track_head import TrackHead, check_track_size, predict_tracks, smallest_side
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.layers import LayerNorm, Params, Start
from vggtjax.network.precision import Compute, full_precision
from vggtjax.network.suppression import Suppression

# The modules of all heads in the parameter tree, and the fields of `Predictions` that they fill.
HEADS = {
    "camera": "camera_head",
    **{name: head.module for name, head in DENSE_HEADS.items()},
    "tracks": "track_head",
    "rays": "ray_head",
}
FIELDS = {
    "camera": ("pose_encoding",),
    **{name: head.fields for name, head in DENSE_HEADS.items()},
    "tracks": ("tracks", "track_visibility", "track_confidence"),
    "rays": ("rays", "rays_confidence"),
}


class Predictions(NamedTuple):
    """Outputs of a pass; None for those that were not requested. Depth and points are up to scale."""

    pose_encoding: Float[Array, "B S 9"] | None = None
    depth: Float[Array, "B S H W"] | None = None
    depth_confidence: Float[Array, "B S H W"] | None = None
    world_points: Float[Array, "B S H W 3"] | None = None
    world_points_confidence: Float[Array, "B S H W"] | None = None
    tracks: Float[Array, "B S Q 2"] | None = None
    track_visibility: Float[Array, "B S Q"] | None = None
    track_confidence: Float[Array, "B S Q"] | None = None
    rays: Float[Array, "B S 8h 8w 6"] | None = None  # world direction and origin
    rays_confidence: Float[Array, "B S 8h 8w"] | None = None
    cue_sums: Any = None  # of the accumulator


class ForwardChanges(TypedDict, total=False):
    """The fields of `Suppression` and `Compute` as keywords of `forward`."""

    dynamic_tokens: Bool[Array, "B S h w"] | Float[Array, "B S h w"] | None
    suppress: Suppress
    mask_pairs: int | Int[Array, ""] | None
    strength: Float[Array, " depth"] | None
    stop_camera_gradient: bool
    compute_dtype: str
    precision: str
    remat: bool
    attention: str
    reference: str
    frames: Frames


def forward(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    features: Features | None = None,
    frame_count: Int[Array, " B"] | None = None,
    cameras: Float[Array, "B S 9"] | None = None,
    outputs: Sequence[str] = ("camera", "depth"),
    query_points: Float[Array, "B Q 2"] | None = None,
    cues: Accumulator | None = None,
    suppression: Suppression = Suppression(),
    **changes: Unpack[ForwardChanges],
) -> Predictions:
    """Run the network on clips, optionally with the keys of dynamic tokens suppressed.

    Pure: works under jit, grad, vmap and remat, and never donates.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1], any number of frames; H and W are multiples of the patch size.
        config: the model's configuration (static under jit).
        features: what `encode` returned for these images; computed here if None.
        frame_count: for clips of different lengths in one batch: number of real frames of each clip, its first ones, at
            least one. The other frames do not influence them. Not with "tracks"; with `cues`, every real frame needs a
            source at the cues' offsets (four frames are enough by default).
        cameras: known cameras of all frames, as pose encodings (`encode_pose`), for a family that reads them.
        outputs: any of "camera", "depth", "points", "tracks", "rays".
        query_points: x, y in pixels of the first frame, the points to track; required with "tracks", invalid without.
        cues: motion cues, or another accumulator, whose sums become `.cue_sums`.
        suppression: the keys to suppress; none for the plain pass.
        changes: fields of `Suppression` (`dynamic_tokens`, `suppress`, `mask_pairs`, `strength`) in place of those of
            `suppression`, and fields of `Compute` (`compute_dtype`, `precision`, `remat`,
            `stop_camera_gradient`, `attention`, `reference`, `frames`).

    Raises:
        InputError: shapes that do not fit, or unknown names. Shapes are static, so this happens while tracing. NaN or
            infinity in images, unless the call is traced.
        TypeError: an unknown keyword.
    """
    if unknown := changes.keys() - ForwardChanges.__annotations__.keys():
        raise TypeError(f"forward() got unexpected keyword arguments: {', '.join(sorted(unknown))}")
    masking = {name: value for name, value in changes.items() if name in Suppression.__dataclass_fields__}
    computing: Any = {name: value for name, value in changes.items() if name not in masking}
    for name in masking.keys() & {"dynamic_tokens", "strength"}:
        masking[name] = masking[name] if masking[name] is None else as_array(name, masking[name])
    query_points = query_points if query_points is None else as_array("query_points", query_points)
    cameras = cameras if cameras is None else as_array("cameras", cameras)
    clips = ClipBatch(as_images(images), features, frame_count, cameras)
    suppression, compute = dataclasses.replace(suppression, **masking), Compute(**computing)
    options = {"outputs": outputs, "query_points": query_points, "accumulator": cues}
    return predict(params, clips, config, **options, suppression=suppression, compute=compute)


@full_precision()
def predict(
    params: Params,
    clips: ClipBatch,
    config: VGGTConfig,
    *,
    outputs: Sequence[str] = ("camera", "depth"),
    query_points: Float[Array, "B Q 2"] | None = None,
    accumulator: Accumulator | None = None,
    suppression: Suppression = Suppression(),
    compute: Compute = Compute(),
) -> Predictions:
    """Run the network as `forward`, whose keywords travel here as values: a batch of clips, a suppression, a compute.

    Outputs that are not requested are not computed.
    """
    grid = patch_grid(clips.images, config)
    _check(params, grid, clips, config, outputs)
    suppression.check((*clips.images.shape[:2], *grid), config.depth)
    _check_queries(clips, config, outputs, query_points)
    features, dtype = clips.features, compute.compute_dtype
    if features is None:
        features = encode(params, clips.images, config, compute_dtype=dtype, remat=compute.remat)
    known = None
    if clips.cameras is not None:
        known = encode_cameras(params, clips, config, compute_dtype=dtype, frames=compute.frames)
    tapped = {"depth_head" if name == "rays" else HEADS[name] for name in outputs if name != "camera"}
    stored = jnp.dtype(compute.compute_dtype)  # taps in bfloat16 add nothing to the error of blocks in bfloat16

    def capture(slot: int):
        def projected(tokens: Float[Array, "B S T E"]) -> dict[str, Array]:
            patches = tap_patches(params, tokens, config)
            taps = {head: project_tap(params[head], patches, slot, config, compute.precision) for head in tapped}
            return {head: tap.astype(stored) for head, tap in taps.items()}

        return projected

    made: Any = Aggregator(config).apply(
        {"params": params["aggregator"]},
        features,
        grid,
        [capture(slot) for slot in range(len(config.taps))],
        camera_tokens=known,
        accumulator=accumulator,
        frame_count=clips.frame_count,
        suppression=suppression,
        compute=compute,
    )
    camera_tokens, taps, sums = made

    def made_by(name: str) -> tuple[Array, ...]:
        if name == "camera":
            pose = predict_pose(
                params,
                camera_tokens,
                config,
                frame_count=clips.frame_count,
                stop_gradient=compute.stop_camera_gradient,
                compute_dtype=compute.compute_dtype,
                frames=compute.frames,
            )
            return (pose,)
        if name == "rays":
            return predict_rays(params, [tap["depth_head"] for tap in taps], config, grid, compute.precision)
        head, projected = params[HEADS[name]], [tap[HEADS[name]] for tap in taps]
        if name == "tracks":
            return predict_tracks(head, projected, query_points, config, grid)  # type: ignore[arg-type]
        regress = jax.checkpoint(predict_dense, static_argnums=(2, 3, 4, 5)) if compute.remat else predict_dense
        values, confidence = regress(head, projected, config, grid, name, compute.precision)
        return values[..., 0] if DENSE_HEADS[name].values == 1 else values, confidence

    fields: dict[str, Any] = {"cue_sums": sums}
    for name in (name for name in HEADS if name in outputs):
        fields |= zip(FIELDS[name], made_by(name), strict=True)
    return Predictions(**fields)


def tap_patches(params: Params, tokens: Float[Array, "B S T E"], config: VGGTConfig) -> Float[Array, "B S P E"]:
    """Return the patches of a tap, E = 2C, as the dense heads read them."""
    patches = tokens[:, :, config.special_tokens :]
    if config.row.norms_features:
        return patches
    own, joint = jnp.split(patches, 2, axis=-1)  # after the frame block, after the global block
    return jnp.concatenate([own, LayerNorm().apply({"params": params["tap_norm"]}, joint)], axis=-1)  # type: ignore


def parameter_shapes(config: VGGTConfig) -> Params:
    """Return the parameter tree's shapes and dtypes (`jax.ShapeDtypeStruct` leaves) without allocating arrays."""
    return unbox(_declared(config))  # a copy of the tree: callers may change it


@lru_cache(maxsize=16)  # a second for each configuration; a run and its checkpoints ask for one many times
def _declared(config: VGGTConfig) -> Params:
    """Return the shapes in the tree of parameters, each in its `Start`."""
    side = -(-smallest_side(config) // config.patch_size)  # patches a side of an image that every head can read
    grid, size = (side, side), side * config.patch_size

    def declare() -> Params:
        def declared(module: nn.Module, *inputs: Any, method: str = "__call__") -> Params:
            return dict(module.init(jax.random.key(0), *inputs, method=method)["params"])

        images = jnp.zeros((1, 1, size, size, 3))
        patches, taps = (jnp.zeros((1, 1, side * side, width)) for width in (config.embed_dim, config.tap_dim))
        features = Features(patches, patches[:, :, 0])
        heads = {
            "camera": lambda: declared(camera_head(config), taps[:, :, 0]),
            **{name: partial(declared, DenseHead(config, name), taps, grid, method="declare") for name in DENSE_HEADS},
            "tracks": lambda: declared(TrackHead(config), taps, grid, method="declare"),
            "rays": lambda: declared(RayHead(config), grid, method="declare"),
        }
        family = {}
        if not config.row.norms_features:
            family["tap_norm"] = declared(LayerNorm(), patches)
        if config.reads_cameras:
            family["camera_encoder"] = declared(CameraEncoder(config), jnp.zeros((1, 1, POSE_SIZE)))
        return {
            "backbone": declared(Backbone(config), images),
            "aggregator": declared(Aggregator(config), features, grid, [identity] * len(config.taps)),
            **family,
            **{HEADS[name]: heads[name]() for name in config.heads},
        }

    return jax.eval_shape(declare)


def init_params(seed: int, config: VGGTConfig) -> Params:
    """Return random parameters to start training from: nested dicts with Flax names, layers stacked on axis 0.

    Every layer says how its parameters start: kernels with variance 1 / fan-in, tables with 0.02^2; LayerScale as in
    VGGT (1 in the backbone, 0.01 elsewhere), the camera head near no motion and a field of view of 1 rad, the dense
    heads near depth 1 and confidence 2, the track head near no motion. Values are drawn on the host, which takes a
    second; compiling jax's generator for every shape takes a minute.
    """
    generator = np.random.default_rng(seed)

    def draw(start: Start) -> Array:
        shape, dtype = start.value.shape, start.value.dtype
        values = start.mean if start.spread == 0 else start.spread * generator.standard_normal(shape, np.float32)
        return jax.device_put(np.broadcast_to(np.asarray(values, dtype), shape))

    return jax.tree.map(draw, _declared(config), is_leaf=lambda leaf: isinstance(leaf, Start))


def _check(params: Params, grid: tuple[int, int], clips: ClipBatch, config: VGGTConfig, outputs: Sequence[str]) -> None:
    check_floats(clips.images)
    tokens_shape = (*clips.images.shape[:2], grid[0] * grid[1], config.embed_dim)
    patch_tokens = None if clips.features is None else clips.features.patch_tokens
    if patch_tokens is not None and tuple(patch_tokens.shape) != tokens_shape:
        raise InputError(f"features have patch tokens of shape {tuple(patch_tokens.shape)}; expected {tokens_shape}")
    if clips.cameras is not None:
        if not config.reads_cameras:
            raise InputError("cameras are given, and this network reads none")
        if tuple(clips.cameras.shape) != (*tokens_shape[:2], POSE_SIZE):
            raise InputError(f"cameras have shape {clips.cameras.shape}; expected {(*tokens_shape[:2], POSE_SIZE)}")
    if clips.frame_count is not None and tuple(clips.frame_count.shape) != tokens_shape[:1]:
        raise InputError(f"frame_count has shape {tuple(clips.frame_count.shape)}; expected {tokens_shape[:1]}")
    if absent := [name for name in outputs if name not in config.heads]:
        raise InputError(f"outputs has {absent}; this model has only the heads {config.heads}")
    for name in outputs:
        if HEADS[name] not in params:
            raise InputError(f"params has no {HEADS[name]!r}; the configuration names the head {name!r}")


def _check_queries(clips: ClipBatch, config: VGGTConfig, outputs: Sequence[str], query_points) -> None:
    B, _, H, W, _ = clips.images.shape
    if ("tracks" in outputs) != (query_points is not None):
        raise InputError("query_points and 'tracks' in outputs go together; give both or neither")
    if query_points is None:
        return
    if clips.frame_count is not None:
        raise InputError("frame_count and query_points are given; tracking requires clips whose frames are all real")
    shape = tuple(query_points.shape)
    if len(shape) != 3 or shape != (B, max(shape[1], 1), 2):
        raise InputError(f"query_points have shape {shape}; expected [{B}, Q, 2] with at least one point")
    check_track_size(H, W, config)
