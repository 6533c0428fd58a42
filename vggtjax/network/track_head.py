"""Track head: points of the first frame followed through all frames (VGGT's tracker, after CoTracker, 2307.07635)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.dpt_head import DPTFeatures, add_positions, declare_features, frames_at_once, resize_aligned
from vggtjax.network.frames import Frames
from vggtjax.network.gathered_attention import gathered_attention
from vggtjax.network.layers import MLP, Dense, LayerNorm, Params, apply, declare
from vggtjax.network.precision import full_precision
from vggtjax.network.sampling import bilinear, neighbours

LAYERS = 6
VIRTUAL_TRACKS = 64
HEADS = 8
ITERATIONS = 4
STRIDE = 2  # pixels of the image to one of the feature maps
FLOW_SCALE = 518.0  # pixels of the feature maps: the unit of flows in the published weights
FLOATS_AT_ONCE = 1 << 24  # in feature windows; bounds the memory of the correlations


class Tracks(NamedTuple):
    """The position of every query point in every frame."""

    positions: Float[Array, "B S Q 2"]  # x, y in pixels; those of the first frame are the queries
    visibility: Float[Array, "B S Q"]  # probability that the point is visible
    confidence: Float[Array, "B S Q"]  # probability that the position is close to the truth


@full_precision
def predict_tracks(
    params: Params,
    taps: list[Float[Array, "B S P F"]],
    query_points: Float[Array, "B Q 2"],
    config: VGGTConfig,
    grid: tuple[int, int],
    frames: Frames = Frames(),
) -> Tracks:
    """Return the tracks of points of the first frame.

    Every iteration compares each track's features with the feature maps around its position, at every level of a
    pyramid; a transformer over time and over tracks then updates position and features. Correlations are computed for
    a few queries at a time, the transformer for all of them, since tracks attend to each other.

    Args:
        params: the head's parameters (`track_head` of the model's tree).
        taps: outputs of `project_tap` for the four taps.
        query_points: x, y in pixels of the first frame.
        config: the model's configuration.
        grid: rows and columns of patches.
        frames: where the frames are: attention over time gathers keys and values of every track, all else is local.
    """
    B, S = taps[0].shape[:2]
    F = config.track_features
    maps = _feature_maps(params, taps, config, grid)  # [B, S, H, W, F]
    size = (maps.shape[2], maps.shape[3])
    query = query_points / STRIDE
    inside = jnp.clip(query, 0, jnp.asarray([[[size[1] - 1, size[0] - 1]]]))
    features = frames.of_first(jax.vmap(bilinear)(maps[:, 0], inside))  # [B, Q, F]
    features = jnp.broadcast_to(features[:, None], (B, S, *features.shape[1:]))
    pyramid = _pyramid(maps, config.track_corr_levels, config.track_corr_radius)
    place = _position_embedding(inside, size, 3 * F + 4)[:, :, None]  # [B, Q, 1, E]
    later = frames.numbers(S) > 0
    kind = params["query_token"][later.astype(np.int32)][None, None]  # [1, 1, S, E]
    start = jnp.broadcast_to(query[:, None], (B, S, *query.shape[1:]))

    def iteration(state, _):
        positions, features = state
        positions = jax.lax.stop_gradient(positions)  # as in VGGT's training
        similar = jax.vmap(_correlations, (0, 0, 0, None, None))(pyramid, features, positions, size, config)
        similar = apply(MLP(config.track_hidden, F), params["correlation_mlp"], similar)
        flow = positions - jax.lax.stop_gradient(start[:, :1])
        x = jnp.concatenate(
            [_flow_embedding(flow, F // 2), flow / FLOW_SCALE, flow / FLOW_SCALE, similar, features], -1
        )
        x = x.swapaxes(1, 2) + place + kind  # [B, Q, S, E]
        delta = _updates(params, x, config, frames).swapaxes(1, 2)  # [B, S, Q, 2 + F]
        update = apply(LayerNorm(), params["feature_norm"], delta[..., 2:])
        update = nn.gelu(apply(Dense(F), params["feature_update"], update), approximate=False)
        positions = jnp.where(jnp.asarray(later)[None, :, None, None], positions + delta[..., :2], start)
        return (positions, features + update), None

    (positions, features), _ = jax.lax.scan(iteration, (start, frames.varying(features)), length=ITERATIONS)
    visibility, confidence = (
        jax.nn.sigmoid(apply(Dense(1), params[name], features)[..., 0]) for name in ("visibility", "confidence")
    )
    return Tracks(positions * STRIDE, visibility, confidence)


def smallest_side(config: VGGTConfig) -> int:
    """Return the smallest side of an image, in pixels, with at least one pixel on every level of the pyramid."""
    return STRIDE * 2 ** (config.track_corr_levels - 1)


def check_track_size(height: int, width: int, config: VGGTConfig) -> None:
    """Raise InputError for frames that are too small to be tracked in."""
    if min(height, width) < smallest_side(config):
        raise InputError(
            f"tracks need frames of at least {smallest_side(config)} pixels a side; these have {height} x {width}: "
            f"the pyramid has {config.track_corr_levels} levels"
        )


def _feature_maps(params: Params, taps: list[Array], config: VGGTConfig, grid: tuple[int, int]) -> Array:
    (h, w), p, F = grid, config.patch_size, config.track_features
    B, S = taps[0].shape[:2]
    size = (h * p // STRIDE, w * p // STRIDE)
    module = DPTFeatures(F, F, config.track_position_embedding)

    def some_frames(frame_taps: list[Float[Array, "n P C"]]) -> Float[Array, "n H W F"]:
        x = apply(module, params["features"], [tap.reshape(-1, h, w, tap.shape[-1]) for tap in frame_taps])
        x = resize_aligned(x, size)
        x = add_positions(x, aspect=w / h) if config.track_position_embedding else x
        return apply(LayerNorm(), params["feature_map_norm"], x)

    return frames_at_once(some_frames, taps, (h * p) * (w * p)).reshape(B, S, *size, F)


def _pyramid(maps: Float[Array, "B S H W F"], levels: int, radius: int) -> list[Float[Array, "B S h w F"]]:
    """Return the maps at every level, each half the size of the previous one, with a border for windows at the edge.

    The border is 0. An axis of a single pixel repeats that pixel, as in the public code, where all coordinates from -1
    to 1 are the same pixel.
    """
    pyramid = []
    for level in range(levels):
        if level:
            B, S, H, W, F = maps.shape
            h, w = H // 2, W // 2
            maps = maps[:, :, : 2 * h, : 2 * w].reshape(B, S, h, 2, w, 2, F).mean(axis=(3, 5))
        border = 2 * radius + 2
        padded = maps
        for axis in (2, 3):
            pads = [(border, border) if i == axis else (0, 0) for i in range(5)]
            padded = jnp.pad(padded, pads, mode="edge" if maps.shape[axis] == 1 else "constant")
        pyramid.append(padded)
    return pyramid


def _correlations(
    pyramid: list[Float[Array, "S h w F"]],
    features: Float[Array, "S Q F"],
    positions: Float[Array, "S Q 2"],
    size: tuple[int, int],
    config: VGGTConfig,
) -> Float[Array, "S Q L"]:
    """Return q . f / sqrt(F) at (2 r + 1)^2 places around each position on every level; x runs slowest.

    Between pixels f is bilinear, and so is its product with q: products with the pixels of a window are computed
    first, then interpolated.
    """
    S, Q, F = features.shape
    window = 2 * config.track_corr_radius + 2
    at_once = min(max(FLOATS_AT_ONCE // (S * window**2 * F), 1), Q)
    padding = -Q % at_once

    def chunks(x: Float[Array, "S Q C"]) -> Float[Array, "K S n C"]:
        x = jnp.pad(x, ((0, 0), (0, padding), (0, 0)))
        return x.reshape(S, -1, at_once, x.shape[-1]).swapaxes(0, 1)

    def some_queries(inputs):
        features, positions = inputs
        levels = []
        for level, maps in enumerate(pyramid):
            sides = [side // 2**level for side in size]
            levels.append(_level(maps, features, positions / 2**level, (sides[0], sides[1]), window))
        return jnp.concatenate(levels, axis=-1)

    products = jax.lax.map(some_queries, (chunks(features), chunks(positions)))
    return products.swapaxes(0, 1).reshape(S, Q + padding, -1)[:, :Q] / F**0.5


def _level(maps, features, positions, size: tuple[int, int], window: int) -> Float[Array, "S n L"]:
    H, W = size
    sides = jnp.asarray([[[W, H]]], jnp.float32)
    position = jnp.where(sides == 1, 0.0, jnp.clip(positions, -window, sides + window))  # beyond, windows are empty
    low = jnp.floor(position)
    fraction = position - low
    corner = low.astype(jnp.int32) + window - (window // 2 - 1)  # the border is as wide as a window
    corner = jnp.clip(corner, 0, jnp.asarray([[[W, H]]], jnp.int32) + window)

    def one(frame: Float[Array, "h w F"], feature: Float[Array, " F"], corner, fraction):
        part = jax.lax.dynamic_slice(frame, (corner[1], corner[0], 0), (window, window, frame.shape[-1]))
        x = jnp.einsum("yxf,f->xy", part, feature)
        x = x[:-1] * (1 - fraction[0]) + x[1:] * fraction[0]
        return (x[:, :-1] * (1 - fraction[1]) + x[:, 1:] * fraction[1]).ravel()

    return jax.vmap(jax.vmap(one, (None, 0, 0, 0)))(maps, features, corner, fraction)


def _position_embedding(query: Float[Array, "B Q 2"], size: tuple[int, int], E: int) -> Float[Array, "B Q E"]:
    """Return sinusoids of x, then of y, exact at whole pixels and linearly interpolated, as from a sampled table."""
    low, high, fraction = neighbours(query, size)
    frequencies = jnp.asarray(1.0 / 10000 ** (np.arange(E // 4) / (E / 4)), jnp.float32)

    def waves(position: Array) -> Array:
        angle = position[..., None].astype(jnp.float32) * frequencies[None, None, None]
        return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=-1)  # [B, Q, 2, E/2]

    embedded = waves(low) * (1 - fraction[..., None]) + waves(high) * fraction[..., None]
    return embedded.reshape(*query.shape[:2], E)


def _flow_embedding(flow: Float[Array, "... 2"], channels: int) -> Float[Array, "... C2"]:
    """Return alternating sines and cosines of x, then of y: `channels` each."""
    frequencies = jnp.asarray(np.arange(0, channels, 2) * (1000.0 / channels), jnp.float32)
    angle = flow[..., None] * frequencies.reshape((1,) * flow.ndim + (-1,))  # [..., 2, channels/2]
    return jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=-1).reshape(*flow.shape[:-1], 2 * channels)


def _updates(params: Params, x: Float[Array, "B Q S E"], config: VGGTConfig, frames: Frames) -> Float[Array, "B Q S O"]:
    """Return the transformer's output: layers alternate over time in every track and over tracks in every frame.

    Tracks attend to each other through virtual tracks: these attend to all tracks and to one another, and all tracks
    attend to them.
    """
    C, Q = config.track_hidden, x.shape[1]
    start = apply(Dense(C), params["input_projection"], apply(LayerNorm(), params["input_norm"], x))
    virtual = params["virtual_tracks"][None, :, None]
    virtual = jnp.broadcast_to(virtual, (x.shape[0], VIRTUAL_TRACKS, x.shape[2], C))
    names = ("time", "virtual_to_point", "virtual", "point_to_virtual")

    def layer(tokens: Float[Array, "B N S C"], blocks: dict[str, Params]):
        tokens = _block(blocks["time"], tokens, frames=frames)
        tokens = tokens.swapaxes(1, 2)  # [B, S, N, C]
        points, virtual = tokens[:, :, :Q], tokens[:, :, Q:]
        virtual = _block(blocks["virtual_to_point"], virtual, points)
        virtual = _block(blocks["virtual"], virtual)
        points = _block(blocks["point_to_virtual"], points, virtual)
        return jnp.concatenate([points, virtual], axis=2).swapaxes(1, 2), None

    tokens, _ = jax.lax.scan(
        layer, jnp.concatenate([start, virtual], axis=1), {name: params[f"{name}_blocks"] for name in names}
    )
    x = apply(LayerNorm(), params["output_norm"], tokens[:, :Q] + start)
    return apply(Dense(config.track_features + 2), params["flow_projection"], x)


def _block(
    params: Params,
    x: Float[Array, "B G T C"],
    context: Float[Array, "B G K C"] | None = None,
    frames: Frames = Frames(),
) -> Float[Array, "B G T C"]:
    """Return attention, to `context` if given, and MLP. The skip starts after the first norm.

    With `frames`, T are frames, and attention is over those of all devices.
    """
    B, G, T, C = x.shape
    x = apply(LayerNorm(), params["norm1"], x)
    source: Array = x if context is None else apply(LayerNorm(), params["norm_context"], context)
    kernels = jnp.split(params["attention"]["qkv"]["kernel"], 3, axis=1)
    biases = jnp.split(params["attention"]["qkv"]["bias"], 3)
    q, k, v = (
        (part @ kernel + bias[None, None, None]).reshape(B * G, -1, HEADS, C // HEADS)
        for part, kernel, bias in zip((x, source, source), kernels, biases, strict=True)
    )
    out = gathered_attention(q, k, v, frames.are_real(None, B * G, T), frames).reshape(B, G, T, C)
    x = x + apply(Dense(C), params["attention"]["projection"], out)
    return x + apply(MLP(4 * C, C), params["mlp"], apply(LayerNorm(), params["norm2"], x))


def declare_track_head(config: VGGTConfig) -> Params:
    """Declare the parameters of the track head."""
    F, C = config.track_features, config.track_hidden
    E = 3 * F + 4  # flow embedding and flow, correlation, track features
    correlations = config.track_corr_levels * (2 * config.track_corr_radius + 1) ** 2

    def declared(module: nn.Module, channels: int) -> Params:
        return declare(module, jnp.zeros((1, 1, channels)))

    def blocks(context: bool) -> Params:
        block = {
            "attention": {"qkv": declared(Dense(3 * C), C), "projection": declared(Dense(C), C)},
            "mlp": declared(MLP(4 * C, C), C),
        }
        for name in ("norm1", "norm2") + ("norm_context",) * context:
            block[name] = declared(LayerNorm(), C)
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LAYERS, *leaf.shape)), block)

    return declare_features(config, DPTFeatures(F, F, config.track_position_embedding)) | {
        "query_token": jnp.zeros((2, E)),
        "virtual_tracks": jnp.zeros((VIRTUAL_TRACKS, C)),
        "correlation_mlp": declared(MLP(C, F), correlations),
        "input_norm": declared(LayerNorm(), E),
        "input_projection": declared(Dense(C), E),
        "time_blocks": blocks(context=False),
        "virtual_blocks": blocks(context=False),
        "point_to_virtual_blocks": blocks(context=True),
        "virtual_to_point_blocks": blocks(context=True),
        "output_norm": declared(LayerNorm(), C),
        "flow_projection": declared(Dense(F + 2), C),
        "feature_map_norm": declared(LayerNorm(), F),
        "feature_norm": declared(LayerNorm(), F),
        "feature_update": declared(Dense(F), F),
        "visibility": declared(Dense(1), F),
        "confidence": declared(Dense(1), F),
    }
