"""Parameters of the track head (VGGT's CoTracker-like point tracker): their names and shapes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from vggtjax.config import VGGTConfig
from vggtjax.network.dpt_head import DPTFeatures, declare_features
from vggtjax.network.layers import MLP, LayerNorm, Params, declare

LAYERS = 6
VIRTUAL_TRACKS = 64


def declare_track_head(config: VGGTConfig) -> Params:
    """Declare the parameters of the track head."""
    F, C = config.track_features, config.track_hidden
    E = 3 * F + 4  # flow embedding, correlation, track features, flow
    correlations = config.track_corr_levels * (2 * config.track_corr_radius + 1) ** 2

    def declared(module: nn.Module, channels: int) -> Params:
        return declare(module, jnp.zeros((1, 1, channels)))

    def blocks(context: bool) -> Params:
        block = {
            "attention": {"qkv": declared(nn.Dense(3 * C), C), "projection": declared(nn.Dense(C), C)},
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
