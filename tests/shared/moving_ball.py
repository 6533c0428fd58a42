"""A clip too simple to ask for understanding: what tests of the way through the library run on."""

import numpy as np
from jaxtyping import Float


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
