"""What a phone makes of light: exposure, white balance, vignetting, noise, blocks of compression."""

from __future__ import annotations

import io

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from vggtjax.clips.media.arrays import in_bytes
from vggtjax.training.world.config import WorldConfig
from vggtjax.training.world.motion import wander


def expose(
    generator: np.random.Generator, light: Float[np.ndarray, "S H W 3"], config: WorldConfig, seconds: float
) -> UInt8[np.ndarray, "S H W 3"]:
    """Return the pictures of a clip: gain, vignette and quality are drawn once, noise and flicker for every frame."""
    S, H, W = light.shape[:3]
    level = float(np.median(light)) + 1e-3
    gain = np.clip(generator.uniform(0.25, 0.55) / level, 0.5, 2.5) ** 0.7
    flicker = wander(generator, config.flicker, seconds, 0.2, 2.0, 3)
    at = np.linspace(0, len(flicker) - 1, S).round().astype(int)
    exposure = gain * np.exp(flicker[at, :1] + 0.15 * flicker[at])
    y, x = np.mgrid[0:H, 0:W].astype(np.float32)
    radius = ((x / (W - 1) - 0.5) ** 2 + (y / (H - 1) - 0.5) ** 2) * 2
    corner = 1 - generator.uniform(0, config.vignette) * radius
    pictures = light * exposure[:, None, None].astype(np.float32) * corner[..., None]
    grain = generator.uniform(0, config.noise)
    pictures = pictures + generator.standard_normal(pictures.shape, np.float32) * np.asarray(grain, np.float32)
    pictures = in_bytes(np.clip(pictures, 0, 1))
    if generator.random() < config.compression:
        quality = int(generator.integers(35, 95))
        pictures = np.stack([_compressed(picture, quality) for picture in pictures])
    return pictures


def _compressed(picture: UInt8[np.ndarray, "H W 3"], quality: int) -> UInt8[np.ndarray, "H W 3"]:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))
