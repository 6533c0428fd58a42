"""The whole network as one pure function: images and patch tokens -> pose encoding, depth, points, tracks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import HEAD_NAMES, Suppress, VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.aggregator import Accumulator, aggregate, declare_aggregator
from vggtjax.network.backbone import declare_backbone, encode, patch_grid
from vggtjax.network.camera_head import ITERATIONS, declare_camera_head, predict_pose
from vggtjax.network.dpt_head import declare_dense_head, predict_dense, project_tap
from vggtjax.network.layers import Params
from vggtjax.network.precision import check_compute_dtype, full_precision
from vggtjax.network.track_head import declare_track_head, predict_tracks, smallest_side
from vggtjax.options import check_mask_pairs

DENSE_HEADS = {"depth": "depth_head", "points": "point_head"}
HEADS = {"camera": "camera_head", **DENSE_HEADS, "tracks": "track_head"}


class Predictions(NamedTuple):
    """What a pass predicts; None where it was not asked for. Depth and points are up to scale."""

    pose_encoding: Float[Array, "B S 9"] | None = None
    depth: Float[Array, "B S H W"] | None = None
    depth_confidence: Float[Array, "B S H W"] | None = None
    world_points: Float[Array, "B S H W 3"] | None = None
    world_points_confidence: Float[Array, "B S H W"] | None = None
    tracks: Float[Array, "B S Q 2"] | None = None
    track_visibility: Float[Array, "B S Q"] | None = None
    track_confidence: Float[Array, "B S Q"] | None = None
    cue_sums: Any = None  # of the accumulator


@full_precision
def forward(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    patch_tokens: Float[Array, "B S P C"] | None = None,
    frame_count: Int[Array, " B"] | None = None,
    dynamic_tokens: Bool[Array, "B S h w"] | Float[Array, "B S h w"] | None = None,
    suppress: Suppress = "zero",
    mask_pairs: int = 5,
    strength: Float[Array, " depth"] | None = None,
    outputs: Sequence[str] = ("camera", "depth"),
    query_points: Float[Array, "B Q 2"] | None = None,
    cues: Accumulator | None = None,
    stop_camera_gradient: bool = True,
    compute_dtype: str = "float32",
    remat: bool = False,
) -> Predictions:
    """Run VGGT on clips, optionally with the keys of dynamic tokens suppressed.

    Pure: works under jit, grad, vmap and remat, and never donates.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1], any number of frames; H and W are multiples of the patch size.
        config: the model's configuration (static under jit).
        patch_tokens: what `encode` returned for these images; computed here if None.
        frame_count: for clips of different lengths in one batch: how many of a clip's frames are real: its first ones,
            one at least.
            The others change nothing in them, whatever they show. Not with "tracks"; and with `cues`, every real frame
            must have a source at the cues' offsets (four frames do by default).
        dynamic_tokens: patches whose keys are suppressed in the first `mask_pairs` pairs; None for the plain pass.
            Shares m in [0, 1] in place of booleans leave k (1 - m) of a key, with a gradient by m.
        suppress: "zero" (the key becomes 0, 4DVGGT-D) or "drop" (key and value leave the softmax, VGGT4D; not for
            shares).
        mask_pairs: number of pairs in which keys are suppressed (L_mask of the paper).
        strength: in place of `mask_pairs`, how much of the suppression every pair takes, in [0, 1]: a key keeps
            k (1 - strength m).
        outputs: any of "camera", "depth", "points", "tracks".
        query_points: x, y in pixels of the first frame, the points to track; given with "tracks" and only then.
        cues: motion cues, or another accumulator, whose sums become `.cue_sums`.
        stop_camera_gradient: whether the camera head's iterations see the previous estimate as a constant.
        compute_dtype: "float32" or "bfloat16" for the blocks' matrix products; norms, residuals and heads are float32.
            "float64", with parameters and images of it and jax.enable_x64, is for checks of gradients.
        remat: compute activations of blocks and dense heads again in the backward pass: less memory, more time.

    Raises:
        InputError: shapes that do not fit, or unknown names. Shapes are static, so this happens while tracing.
    """
    grid = patch_grid(images, config)
    _check(grid, images, config, patch_tokens, dynamic_tokens, suppress, mask_pairs, outputs, compute_dtype)
    _check_strength(config, dynamic_tokens, suppress, strength)
    _check_queries(images, config, outputs, query_points, frame_count)
    if patch_tokens is None:
        patch_tokens = encode(params, images, config, compute_dtype=compute_dtype, remat=remat)
    dense = [name for name in outputs if name in DENSE_HEADS]
    tapped = [HEADS[name] for name in outputs if name != "camera"]

    def capture(slot: int):
        def kept(tokens: Float[Array, "B S T E"]) -> dict[str, Array]:
            patches = tokens[:, :, -grid[0] * grid[1] :]
            return {head: project_tap(params[head], patches, slot, config) for head in tapped}

        return kept

    camera_tokens, taps, sums = aggregate(
        params,
        patch_tokens,
        config,
        grid,
        captures=[capture(slot) for slot in range(len(config.taps))],
        accumulator=cues,
        frame_count=frame_count,
        dynamic_tokens=dynamic_tokens,
        suppress=suppress,
        mask_pairs=mask_pairs,
        strength=strength,
        compute_dtype=compute_dtype,
        remat=remat,
    )
    found: dict[str, Any] = {"cue_sums": sums}
    if "camera" in outputs:
        found["pose_encoding"] = predict_pose(
            params, camera_tokens, config, frame_count=frame_count, stop_gradient=stop_camera_gradient
        )
    densely = jax.checkpoint(predict_dense, static_argnums=(2, 3, 4)) if remat else predict_dense
    for name in dense:
        head = DENSE_HEADS[name]
        values, confidence = densely(params[head], [tap[head] for tap in taps], config, grid, name)
        if name == "depth":
            found |= {"depth": values[..., 0], "depth_confidence": confidence}
        else:
            found |= {"world_points": values, "world_points_confidence": confidence}
    if query_points is not None:
        head = HEADS["tracks"]
        tracks = predict_tracks(params[head], [tap[head] for tap in taps], query_points, config, grid)
        found |= {
            "tracks": tracks.positions,
            "track_visibility": tracks.visibility,
            "track_confidence": tracks.confidence,
        }
    return Predictions(**found)


def parameter_shapes(config: VGGTConfig) -> Params:
    """Return the parameter tree's shapes and dtypes (`jax.ShapeDtypeStruct` leaves) without making any array."""

    declarations = {
        "camera": declare_camera_head,
        "depth": partial(declare_dense_head, kind="depth"),
        "points": partial(declare_dense_head, kind="points"),
        "tracks": declare_track_head,
    }

    def declare() -> Params:
        trunk = {"backbone": declare_backbone(config), "aggregator": declare_aggregator(config)}
        return trunk | {HEADS[name]: declarations[name](config) for name in config.heads}

    return jax.eval_shape(declare)


def init_params(seed: int, config: VGGTConfig) -> Params:
    """Return random parameters to start training from: nested dicts with Flax names, layers stacked on axis 0.

    Values are drawn on the host, leaf by leaf: compiling jax's generator for every shape takes a minute, this a second.
    Kernels have variance 1 / fan-in, tables 0.02^2; LayerScale starts as in VGGT (1 in the backbone, 0.01 elsewhere),
    the camera head near no motion and a field of view of 1 rad, the dense heads near depth 1 and confidence 2, the
    track head near no motion too.
    """
    generator = np.random.default_rng(seed)

    def draw(path: tuple, leaf: jax.ShapeDtypeStruct) -> Array:
        names = [entry.key for entry in path]
        if names[-1] in ("bias", "empty_pose"):
            values = np.zeros(leaf.shape)
        elif names[-1] == "scale":
            values = np.ones(leaf.shape)
        elif names[-1] in ("scale1", "scale2"):
            values = np.full(leaf.shape, 1.0 if names[0] == "backbone" else 0.01)
        else:
            stacked = any(name.endswith("blocks") or name == "trunk" for name in names)
            fan_in = leaf.shape[0] if "upsample" in names[-2] else np.prod(leaf.shape[stacked:-1])
            spread = fan_in**-0.5 if names[-1] == "kernel" else 0.02
            values = spread * generator.standard_normal(leaf.shape, np.float32)
        return jnp.asarray(values, leaf.dtype)

    params = jax.tree_util.tree_map_with_path(draw, parameter_shapes(config))
    if "camera" in config.heads:
        start = np.array([0, 0, 0, 0, 0, 0, 1, 1, 1]) / ITERATIONS  # every iteration adds it
        pose = params["camera_head"]["pose_branch"]["fc2"]
        pose |= {"kernel": 0.1 * pose["kernel"], "bias": jnp.asarray(start, jnp.float32)}
    for name in DENSE_HEADS.keys() & set(config.heads):  # exp of what comes in at full size would overflow
        params[DENSE_HEADS[name]]["regression"]["conv2"]["kernel"] *= 0.01
    if "tracks" in config.heads:
        params["track_head"]["flow_projection"]["kernel"] *= 0.01  # tracks start by standing still
    return params


def _check(grid, images, config, patch_tokens, dynamic_tokens, suppress, mask_pairs, outputs, compute_dtype) -> None:
    B, S = images.shape[:2]
    tokens_shape = (B, S, grid[0] * grid[1], config.embed_dim)
    if patch_tokens is not None and tuple(patch_tokens.shape) != tokens_shape:
        raise InputError(f"patch_tokens have shape {tuple(patch_tokens.shape)}; expected {tokens_shape}")
    if dynamic_tokens is not None and tuple(dynamic_tokens.shape) != (B, S, *grid):
        raise InputError(f"dynamic_tokens have shape {tuple(dynamic_tokens.shape)}; expected {(B, S, *grid)}")
    if dynamic_tokens is not None and dynamic_tokens.dtype != bool and not _is_floating(dynamic_tokens):
        raise InputError(f"dynamic_tokens have type {dynamic_tokens.dtype}; expected bool, or shares as floats")
    check_mask_pairs(mask_pairs)
    if unknown := [name for name in outputs if name not in HEAD_NAMES]:
        raise InputError(f"outputs has {unknown}; expected some of {HEAD_NAMES}")
    if absent := [name for name in outputs if name not in config.heads]:
        raise InputError(f"outputs has {absent}, and this model has only the heads {config.heads}")
    if suppress not in ("zero", "drop"):
        raise InputError(f"suppress is {suppress!r}; expected 'zero' or 'drop'")
    check_compute_dtype(compute_dtype)


def _check_strength(config: VGGTConfig, dynamic_tokens, suppress, strength) -> None:
    if suppress != "zero" and (strength is not None or (dynamic_tokens is not None and _is_floating(dynamic_tokens))):
        raise InputError(
            f"suppress is {suppress!r} with shares of tokens or a strength; expected 'zero': a key that is dropped is "
            "dropped whole"
        )
    if strength is not None and tuple(strength.shape) != (config.depth,):
        raise InputError(f"strength has shape {tuple(strength.shape)}; expected {(config.depth,)}, one for each pair")


def _is_floating(x: Array) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def _check_queries(images, config: VGGTConfig, outputs: Sequence[str], query_points, frame_count) -> None:
    B, _, H, W, _ = images.shape
    if ("tracks" in outputs) != (query_points is not None):
        raise InputError("query_points and 'tracks' in outputs go together; give both or neither")
    if query_points is None:
        return
    if frame_count is not None:
        raise InputError("frame_count and query_points are given; tracks are of clips whose frames are all real")
    if len(query_points.shape) != 3 or query_points.shape[0] != B or query_points.shape[2] != 2:
        raise InputError(f"query_points have shape {tuple(query_points.shape)}; expected {(B, 'Q', 2)}")
    if query_points.shape[1] < 1:
        raise InputError("query_points are empty; give at least one point")
    if min(H, W) < smallest_side(config):
        raise InputError(
            f"tracks need frames of at least {smallest_side(config)} pixels a side; these have {H} x {W}: "
            f"the pyramid has {config.track_corr_levels} levels"
        )
