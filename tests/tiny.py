"""The smallest network with every part: what tests compile that need no real size."""

from typing import Any

from vggtjax import init_params
from vggtjax.checkpoint import Model
from vggtjax.config import VGGTConfig


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
    }
    return VGGTConfig(**(fields | changes))


def tiny_model() -> Model:
    """Return the tiny network with seeded parameters."""
    config = tiny_config()
    return Model(config, init_params(0, config), "tiny")
