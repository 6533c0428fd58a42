"""Parameters of the track head (VGGT's CoTracker-like point tracker): its leaves and their shapes."""

from __future__ import annotations

from flax import linen as nn
from jax import Array
from jax import numpy as jnp

from vggtjax.config import VGGTConfig
from vggtjax.network.dpt_head import DPTFeatures, declare_features
from vggtjax.network.layers import MLP, LayerNorm, Params, declare, declare_stacked

LAYERS = 6
VIRTUAL_TRACKS = 64


class AttentionWeights(nn.Module):
    """The two matrices of a multi-head attention whose q, k and v are computed as one."""

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        nn.Dense(3 * self.features, name="qkv")(x)
        return nn.Dense(self.features, name="projection")(x)


class UpdateBlock(nn.Module):
    """A block of the update transformer; with a context it attends to that instead of to itself."""

    features: int
    context: bool = False

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for name in ("norm1", "norm2") + ("norm_context",) * self.context:
            x = LayerNorm(name=name)(x)
        x = AttentionWeights(self.features, name="attention")(x)
        return MLP(4 * self.features, self.features, name="mlp")(x)


def declare_track_head(config: VGGTConfig) -> Params:
    """Declare the parameters of the track head."""
    F, C = config.track_features, config.track_hidden
    E = 3 * F + 4  # flow embedding, correlation, track features, flow
    correlations = config.track_corr_levels * (2 * config.track_corr_radius + 1) ** 2

    def declared(module: nn.Module, channels: int) -> Params:
        return declare(module, jnp.zeros((1, 1, channels)))

    def blocks(context: bool) -> Params:
        return declare_stacked(UpdateBlock(C, context), LAYERS, jnp.zeros((1, 1, C)))

    return declare_features(config, DPTFeatures(F, F, config.track_position_embedding)) | {
        "query_token": jnp.zeros((2, E)),
        "virtual_tracks": jnp.zeros((VIRTUAL_TRACKS, C)),
        "correlation_mlp": declared(MLP(C, F), correlations),
        "input_norm": declared(LayerNorm(), E),
        "input_projection": declared(nn.Dense(C), E),
        "time_blocks": blocks(context=False),
        "virtual_blocks": blocks(context=False),
        "point_to_virtual_blocks": blocks(context=True),
        "virtual_to_point_blocks": blocks(context=True),
        "output_norm": declared(LayerNorm(), C),
        "flow_projection": declared(nn.Dense(F + 2), C),
        "feature_map_norm": declared(LayerNorm(), F),
        "feature_norm": declared(LayerNorm(), F),
        "feature_update": declared(nn.Dense(F), F),
        "visibility": declared(nn.Dense(1), F),
        "confidence": declared(nn.Dense(1), F),
    }
