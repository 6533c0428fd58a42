"""The tiny model of `vggtjax demo`: VGGT-1B's structure, pair for pair, with a thousandth of its parameters."""

from __future__ import annotations

import jax
import numpy as np

from vggtjax.checkpoint import DType, Model, numpy_dtype
from vggtjax.config import VGGTConfig
from vggtjax.network.model import init_params


def demo_config() -> VGGTConfig:
    """Return the configuration of the demo's model."""
    return VGGTConfig(
        image_size=140,
        embed_dim=32,
        num_heads=2,
        dino_depth=3,
        dino_num_heads=2,
        camera_num_heads=4,
        dpt_features=16,
        dpt_channels=(16, 16, 32, 32),
        track_features=16,
        track_hidden=48,
        track_corr_levels=5,
        track_corr_radius=3,
    )


def demo_model(dtype: DType = "float32") -> Model:
    """Return the demo's model, which is untrained: it shows the way through the library, not a reconstruction."""
    config = demo_config()
    params = init_params(0, config)
    if dtype != "float32":  # by numpy: XLA would compile the cast for every shape
        params = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf).astype(numpy_dtype(dtype))), params)
    return Model(config, params, "demo", trained=False)
