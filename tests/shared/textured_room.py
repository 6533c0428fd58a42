"""The room with a pattern that is painted on its wall, so that the pictures agree from frame to frame."""

from typing import Any

import numpy as np

from tests.shared.room import make_room
from vggtjax.results.reconstruction import Reconstruction


def textured_room(frames: int = 6, **changes: Any) -> Reconstruction:
    """Return the room at 84 x 56 pixels with waves on its wall and box; `changes` replace fields after painting."""
    room = make_room(frames, 56, 84)
    x, y, _ = np.moveaxis(room.world_points().astype(np.float64), -1, 0)
    waves = np.random.default_rng(3).uniform(1, 6, (6, 2)) * np.array([[1, 1], [1, -1]] * 3)
    grey = sum(np.sin(a * x + b * y + a) for a, b in waves)
    images = np.clip(127 + 25 * grey, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=-1)
    return make_room(frames, 56, 84, **({"images": images} | changes))
