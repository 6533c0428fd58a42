"""Batches of generated clips, and the keys to suppress, drawn on the device from one key for each step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.training.objective import Batch
from vggtjax.training.recipe import Phase
from vggtjax.training.scenes.render import SyntheticClip, generate
from vggtjax.training.scenes.textures import Textures
from vggtjax.training.truth import Clips, clips_of, mirrored
from vggtjax.training.world.pool import PoolClip

GREY = 0.1  # share of clips without colour
MIRRORED = 0.5  # share of clips of worlds whose left and right are exchanged
IN_ORDER = 0.5  # share of clips with frames in order of time
_SUPPRESSION = 1 << 20  # folded into keys: an index beyond those of `split`, so that the clips stay the same
_REGIONS = 2  # at most, in a clip
_HALF_AXES = (0.1, 0.35)  # range, in shares of the frame's height and width
_POWERS = (1.5, 6.0)  # range of the exponent: from almost a diamond to almost a rectangle
_TRAVEL = 0.5  # largest travel from the first frame to the last, in shares of the frame


def make_batch(key: Array, textures: Textures, phase: Phase, frames: int, patch_size: int) -> Batch:
    """Return the batch of a JAX random key: `phase.batch` clips of `frames` frames, in random order and colours.

    The clips have the phase's height and width; its further `sizes` are not read. In a share `phase.suppressed` of the
    clips, random regions are suppressed, in the same pairs of blocks. Pure; all but `key` and `textures` is static.
    """
    config = phase.scenes(frames)
    drawn = phase.suppressed or phase.worlds  # steps of scenes and of worlds then are one program

    def one(key: Array) -> tuple[SyntheticClip, Array | None]:
        scene_key, order_key, colour_key = jax.random.split(key, 3)
        clip = generate(scene_key, textures, config)
        shuffle_key, coin_key = jax.random.split(order_key)
        order = jax.random.permutation(shuffle_key, frames)
        order = jnp.where(jax.random.uniform(coin_key) < IN_ORDER, jnp.arange(frames), order)
        clip = jax.tree.map(lambda leaf: leaf[order], clip)
        clip = clip._replace(images=_recolour(colour_key, clip.images, phase.gamma))
        return clip, _regions(key, phase, frames)[order] if drawn else None

    scenes, regions = jax.vmap(one)(jax.random.split(key, phase.batch))
    clips = clips_of(scenes, patch_size)
    return Batch(clips) if regions is None else _suppressing(key, phase, clips, regions)


def make_world_batch(key: Array, clips: PoolClip, phase: Phase, frames: int) -> Batch:
    """Return the batch of clips of worlds, [phase.batch, frames, ...], in random colours, half of them mirrored.

    In a share `phase.masked_movers` of the clips in which something moves, its keys are suppressed. In clips at rest
    those of random regions are, as in scenes. Pure; `phase` and `frames` are static.
    """
    moving = jnp.asarray(clips.moving)
    moves = moving.any(axis=(1, 2, 3))

    def one(key: Array, images: Array, moving: Array, moves: Array) -> tuple[Array, Array, Array]:
        mirror_key, order_key, colour_key = jax.random.split(key, 3)
        masked = moves & (jax.random.uniform(order_key) < phase.masked_movers)
        images = _recolour(colour_key, images.astype(jnp.float32) / 255, phase.gamma)
        regions = jnp.where(masked, moving, _regions(key, phase, frames) & ~moves)
        return images, regions, jax.random.uniform(mirror_key) < MIRRORED

    keys = jax.random.split(key, phase.batch)
    images, regions, is_mirrored = jax.vmap(one)(keys, jnp.asarray(clips.images), moving, moves)
    truth = clips.camera_from_world, clips.intrinsics, clips.tracks
    seen = Clips(images, *(jnp.asarray(values, jnp.float32) for values in (clips.depth, *truth)))
    seen, regions = jax.tree.map(
        lambda a, b: jnp.where(is_mirrored.reshape(-1, *(1,) * (a.ndim - 1)), a, b),
        (mirrored(seen), regions[..., ::-1]),
        (seen, regions),
    )
    return _suppressing(key, phase, seen, regions)


def _regions(key: Array, phase: Phase, frames: int) -> Bool[Array, "S H W"]:
    """Return random regions in a share `phase.suppressed` of clips, none in the others."""
    region_key, coin_key = jax.random.split(jax.random.fold_in(key, _SUPPRESSION))
    regions = random_regions(region_key, frames, phase.height, phase.width)
    return regions & (jax.random.uniform(coin_key) < phase.suppressed)


def _suppressing(key: Array, phase: Phase, clips: Clips, regions: Bool[Array, "B S H W"]) -> Batch:
    low, high = phase.suppressed_pairs
    pairs = high - (high - low) * jax.random.uniform(jax.random.fold_in(key, _SUPPRESSION))
    return Batch(clips, regions, jnp.broadcast_to(pairs, (phase.batch,)), phase.suppress)


def _recolour(key: Array, images: Array, width: float) -> Array:
    """Return images with another gain per channel and gamma, or grey; the same for all frames of a clip.

    The logarithm of gamma is uniform in [-width / 2, width / 2].
    """
    draw = jax.random.uniform(key, (5,))
    grey = images.mean(axis=-1, keepdims=True)
    images = jnp.where(draw[0] < GREY, grey, images)
    gamma = jnp.exp(width * (draw[1] - 0.5))
    gain = jnp.exp(0.3 * (draw[2:] - 0.5))
    return jnp.clip(jnp.maximum(images, 1e-4) ** gamma * gain[None, None, None], 0, 1)


def random_regions(key: Array, frames: int, height: int, width: int) -> Bool[Array, "S H W"]:
    """Return one or two super-ellipses that move at constant speed; S frames in order of time.

    Their keys are suppressed in training, as a second pass suppresses keys.
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
