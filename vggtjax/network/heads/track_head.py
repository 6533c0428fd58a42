"""Track head: points of the first frame followed through all frames (VGGT's tracker, after CoTracker, 2307.07635)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.heads.dpt_head import DPTFeatures, TapHead, add_positions, frames_at_once
from vggtjax.network.heads.resize import resize_aligned
from vggtjax.network.heads.sampling import bilinear, neighbours
from vggtjax.network.kernels.attention import attention as attention_of
from vggtjax.network.layers import MLP, TABLE, ZEROS, Dense, LayerNorm, Params, by_fan_in, over_layers, repeated
from vggtjax.network.precision import full_precision

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


@full_precision()
def predict_tracks(
    params: Params,
    taps: list[Float[Array, "B S P F"]],
    query_points: Float[Array, "B Q 2"],
    config: VGGTConfig,
    grid: tuple[int, int],
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
    """
    return TrackHead(config).apply({"params": params}, taps, query_points, grid)  # type: ignore


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


class TrackHead(TapHead):
    """Iterations of correlations and a transformer; arguments as those of `predict_tracks`."""

    @nn.compact
    def __call__(
        self,
        taps: list[Float[Array, "B S P F"]],
        query_points: Float[Array, "B Q 2"],
        grid: tuple[int, int],
    ) -> Tracks:
        """Return the tracks of points of the first frame."""
        B, S = taps[0].shape[:2]
        config, F, C = self.config, self.config.track_features, self.config.track_hidden
        maps = self._feature_maps(taps, grid)  # [B, S, H, W, F]
        size = (maps.shape[2], maps.shape[3])
        query = query_points / STRIDE
        inside = jnp.clip(query, 0, jnp.asarray([[[size[1] - 1, size[0] - 1]]], query.dtype))
        features = jax.vmap(bilinear)(maps[:, 0], inside)  # [B, Q, F]
        features = jnp.broadcast_to(features[:, None], (B, S, *features.shape[1:]))
        pyramid = _pyramid(maps, config.track_corr_levels, config.track_corr_radius)
        place = _position_embedding(inside, size, 3 * F + 4)[:, :, None]  # [B, Q, 1, E]
        later = np.arange(S) > 0
        kind = self.param("query_token", TABLE, (2, 3 * F + 4))[later.astype(np.int32)][None, None]  # [1, 1, S, E]
        start = jnp.broadcast_to(query[:, None], (B, S, *query.shape[1:]))
        compare, transform = MLP(C, F, name="correlation_mlp"), self._transformer()
        feature_norm, feature_update = LayerNorm(name="feature_norm"), Dense(F, name="feature_update")
        scores = [Dense(1, name=name) for name in ("visibility", "confidence")]

        def iteration(state):
            positions, features = state
            positions = jax.lax.stop_gradient(positions)  # as in VGGT's training
            similar = jax.vmap(_correlations, (0, 0, 0, None, None))(pyramid, features, positions, size, config)
            similar = compare(similar)
            flow = positions - jax.lax.stop_gradient(start[:, :1])
            x = jnp.concatenate(
                [_flow_embedding(flow, F // 2), flow / FLOW_SCALE, flow / FLOW_SCALE, similar, features], -1
            )
            x = x.swapaxes(1, 2) + place + kind  # [B, Q, S, E]
            delta = transform(x).swapaxes(1, 2)  # [B, S, Q, 2 + F]
            update = nn.gelu(feature_update(feature_norm(delta[..., 2:])), approximate=False)
            positions = jnp.where(jnp.asarray(later)[None, :, None, None], positions + delta[..., :2], start)
            return positions, features + update

        positions, features = repeated(self, iteration, (start, features), ITERATIONS)
        visibility, confidence = (jax.nn.sigmoid(score(features)[..., 0]) for score in scores)
        return Tracks(positions * STRIDE, visibility, confidence)

    def declare(self, tokens: Float[Array, "B S P E"], grid: tuple[int, int]) -> None:
        """Read every parameter once."""
        self(self.project_all(tokens), jnp.zeros((1, 1, 2)), grid)

    def _feature_maps(self, taps: list[Float[Array, "B S P F"]], grid: tuple[int, int]) -> Float[Array, "B S H W F"]:
        (h, w), p, F = grid, self.config.patch_size, self.config.track_features
        size = (h * p // STRIDE, w * p // STRIDE)
        has_positions = self.config.track_position_embedding
        reassemble, norm = DPTFeatures(F, F, has_positions, name="features"), LayerNorm(name="feature_map_norm")

        def some_frames(taps: list[Float[Array, "n P C"]]) -> Float[Array, "n H W F"]:
            x = resize_aligned(reassemble([tap.reshape(-1, h, w, tap.shape[-1]) for tap in taps]), size)
            return norm(add_positions(x, aspect=w / h) if has_positions else x)

        return frames_at_once(some_frames, taps, (h * p) * (w * p)).reshape(*taps[0].shape[:2], *size, F)

    def _transformer(self) -> Callable[[Float[Array, "B Q S E"]], Float[Array, "B Q S O"]]:
        """Return the transformer: layers alternate over time in every track and over tracks in every frame.

        Tracks attend to each other through virtual tracks: these attend to all tracks and to one another, and all
        tracks attend to them.
        """
        C, F = self.config.track_hidden, self.config.track_features
        names = ("time", "virtual_to_point", "virtual", "point_to_virtual")
        layers = over_layers(TrackLayer, LAYERS)(*(TrackBlock(name=f"{name}_blocks") for name in names))
        virtual_tracks = self.param("virtual_tracks", TABLE, (VIRTUAL_TRACKS, C))
        input_norm, input_projection = LayerNorm(name="input_norm"), Dense(C, name="input_projection")
        output_norm, flow_projection = LayerNorm(name="output_norm"), Dense(F + 2, gain=0.01, name="flow_projection")

        def transform(x: Float[Array, "B Q S E"]) -> Float[Array, "B Q S O"]:
            start = input_projection(input_norm(x))
            virtual = jnp.broadcast_to(virtual_tracks[None, :, None], (x.shape[0], VIRTUAL_TRACKS, x.shape[2], C))
            tokens, _ = layers(jnp.concatenate([start, virtual], axis=1))
            return flow_projection(output_norm(tokens[:, : x.shape[1]] + start))

        return transform


class TrackLayer(nn.Module):
    """A layer of the transformer as the body of a loop: over time, then over tracks."""

    time: TrackBlock
    virtual_to_point: TrackBlock
    virtual: TrackBlock
    point_to_virtual: TrackBlock

    def __call__(self, tokens: Float[Array, "B N S C"], _: None = None) -> tuple[Float[Array, "B N S C"], None]:
        """Return the tokens after the layer."""
        tokens = self.time(tokens).swapaxes(1, 2)  # [B, S, N, C]
        points, virtual = tokens[:, :, :-VIRTUAL_TRACKS], tokens[:, :, -VIRTUAL_TRACKS:]
        virtual = self.virtual(self.virtual_to_point(virtual, points))
        points = self.point_to_virtual(points, virtual)
        return jnp.concatenate([points, virtual], axis=2).swapaxes(1, 2), None


class TrackBlock(nn.Module):
    """Attention, to `context` if given, and MLP. The skip starts after the first norm."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "B G T C"], context: Float[Array, "B G K C"] | None = None
    ) -> Float[Array, "B G T C"]:
        """Return the tokens after the block."""
        B, G, T, C = x.shape
        x = LayerNorm(name="norm1")(x)
        source = x if context is None else LayerNorm(name="norm_context")(context)
        attention = SplitProjections(C, name="attention")
        q, k, v = (y.reshape(B * G, -1, HEADS, C // HEADS) for y in attention.heads(x, source))
        out = attention_of(q, k, v).reshape(B, G, T, C)
        x = x + attention.project(out)
        return x + MLP(4 * C, C, name="mlp")(LayerNorm(name="norm2")(x))


class SplitProjections(nn.Module):
    """The linear layers of attention whose keys and values may come from other tokens than its queries."""

    channels: int

    def setup(self) -> None:
        self.qkv = SplitDense(self.channels)
        self.projection = Dense(self.channels)

    def heads(self, x: Float[Array, "... T C"], source: Float[Array, "... K C"]) -> list[Array]:
        """Return q of x, and k and v of `source`."""
        return self.qkv([x, source, source])

    def project(self, y: Float[Array, "... C"]) -> Float[Array, "... C"]:
        """Return what attention adds to the residual stream."""
        return self.projection(y)


class SplitDense(nn.Module):
    """A linear layer whose outputs are cut into parts, each of an input of its own."""

    channels: int

    @nn.compact
    def __call__(self, parts: list[Float[Array, "... C"]]) -> list[Float[Array, "... C"]]:
        count = len(parts)
        kernel = self.param("kernel", by_fan_in(), (parts[0].shape[-1], count * self.channels))
        bias = self.param("bias", ZEROS, (count * self.channels,))
        pieces = zip(parts, jnp.split(kernel, count, axis=1), jnp.split(bias, count), strict=True)
        return [part @ kernel + bias[None, None, None] for part, kernel, bias in pieces]


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
