"""Random regions that move through a clip: their keys are suppressed in training, as a second pass suppresses keys."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_REGIONS = 2  # at most, in a clip
_HALF_AXES = (0.1, 0.35)  # range, in shares of the frame's height and width
_POWERS = (1.5, 6.0)  # range of the exponent: from almost a diamond to almost a rectangle
_TRAVEL = 0.5  # largest travel from the first frame to the last, in shares of the frame


def random_regions(key: Array, frames: int, height: int, width: int) -> Bool[Array, "S H W"]:
    """Return one or two super-ellipses that move at constant speed; S frames in order of time.

    The regions depend on the key alone and not on the scene. Pure; all but `key` is static.
    """
    draw = jax.random.uniform(key, (_REGIONS, 8))
    centre, axes, travel = draw[:, :2], _between(draw[:, 2:4], *_HALF_AXES), _between(draw[:, 4:6], -_TRAVEL, _TRAVEL)
    power, is_present = _between(draw[:, 6], *_POWERS), (jnp.arange(_REGIONS) == 0) | (draw[:, 7] < 0.5)
    times = np.linspace(-0.5, 0.5, frames, dtype=np.float32)  # the centre is that of the middle of the clip
    y, x = ((np.arange(count, dtype=np.float32) + 0.5) / count for count in (height, width))
    place = centre[:, None] + times[None, :, None] * travel[:, None]  # [regions, S, 2]
    dy = jnp.abs(y[None, None] - place[..., :1]) / axes[:, None, :1]  # [regions, S, H]
    dx = jnp.abs(x[None, None] - place[..., 1:]) / axes[:, None, 1:]
    power = power[:, None, None]
    inside = (dy**power)[..., :, None] + (dx**power)[..., None, :] < 1
    return (inside & is_present[:, None, None, None]).any(axis=0)


def _between(draw: Float[Array, ...], low: float, high: float) -> Float[Array, ...]:
    return low + (high - low) * draw
