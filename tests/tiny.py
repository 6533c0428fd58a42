"""A model too small to see anything, and a clip too simple to ask for it: what the tests run fast on."""

import numpy as np
from jaxtyping import Float

from vggtjax.checkpoint import Model
from vggtjax.config import VGGTConfig
from vggtjax.network.model import init_params


def tiny_config() -> VGGTConfig:
    """Return the configuration of the golden files' model: 24 pairs like VGGT-1B, 32 channels."""
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


def tiny_model() -> Model:
    """Return random parameters of that configuration."""
    config = tiny_config()
    return Model(config, init_params(0, config), "tiny", trained=False)


def moving_ball(frames: int = 8, size: int = 140) -> Float[np.ndarray, "S H W 3"]:
    """Return RGB frames in [0, 1]: a textured wall and floor, a panning camera, and a ball that crosses."""
    generator = np.random.default_rng(0)
    waves = generator.normal(size=(24, 5))
    y, x = np.mgrid[0:size, 0:size] / size
    result = np.zeros((frames, size, size, 3), np.float32)
    for frame in range(frames):
        time = frame / max(frames - 1, 1)
        pan = x + 0.25 * time * (0.6 + y)  # the floor is nearer than the wall and slides faster
        texture = sum(np.sin(20 * (a * pan + b * y) + 6 * c) for a, b, c, _, _ in waves) / 8
        shade = np.where(y > 0.6, 0.35, 0.6) + 0.15 * texture
        picture = shade[..., None] * np.array([0.9, 0.8, 0.65]) + 0.1 * y[..., None] * np.array([0.2, 0.5, 0.9])
        centre_x, centre_y = 0.15 + 0.7 * time, 0.62 - 0.9 * time * (1 - time)
        distance = np.hypot(x - centre_x, y - centre_y) / 0.13
        light = 0.35 + 0.65 * np.clip(1 - np.hypot(x - centre_x + 0.04, y - centre_y + 0.05) / 0.2, 0, 1)
        picture = np.where((distance < 1)[..., None], light[..., None] * np.array([0.95, 0.25, 0.15]), picture)
        result[frame] = np.clip(picture, 0, 1)
    return result
