"""The smallest network with every part, for tests that need no real size."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax

from vggtjax import init_params
from vggtjax.config import MotionConfig, VGGTConfig
from vggtjax.network.checkpoint import Model, save_model
from vggtjax.network.layers import Params
from vggtjax.pipeline.pretrained.embedded import NOTE, UNTRAINED_HEADS


def tiny_config(**changes: Any) -> VGGTConfig:
    """Return four pairs of sixteen channels; `changes` replace fields."""
    fields: dict[str, Any] = {
        "image_size": 56,
        "embed_dim": 16,
        "depth": 4,
        "taps": (0, 1, 2, 3),
        "num_heads": 2,
        "dino_depth": 1,
        "dino_num_heads": 2,
        "camera_depth": 1,
        "camera_num_heads": 2,
        "dpt_features": 8,
        "dpt_channels": (8, 8, 8, 8),
        "track_features": 8,
        "track_hidden": 16,
        "track_corr_levels": 2,
        "track_corr_radius": 1,
    }
    return VGGTConfig(**(fields | changes))


def tiny_model(**changes: Any) -> Model:
    """Return the tiny network with seeded parameters; `changes` replace fields of its configuration."""
    config = tiny_config(**changes)
    return Model(config, jax.device_put(_params(config)), "tiny")


@functools.cache
def _params(config: VGGTConfig) -> Params:
    return jax.device_get(init_params(0, config))


def save_tiny_demo(path: Path) -> Path:
    """Write the tiny network as a stand-in for the embedded model: its sizes of images and patches, its note."""
    config = dataclasses.replace(tiny_config(image_size=96, patch_size=8), motion=MotionConfig(mask_pairs=4))
    return save_model(path, _params(config), config, name="demo", note=NOTE, untrained_heads=UNTRAINED_HEADS)
