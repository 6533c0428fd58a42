"""Batches of generated clips, and the keys to suppress, drawn on the device from one key for each step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from vggtjax.training.batch import Batch
from vggtjax.training.recipe import Phase
from vggtjax.training.regions import random_regions
from vggtjax.training.scenes.render import SyntheticClip, generate
from vggtjax.training.scenes.textures import Textures

GREY = 0.1  # share of clips without colour
IN_ORDER = 0.5  # share of clips with frames in order of time
_SUPPRESSION = 1 << 20  # folded into keys: an index beyond those of `split`, so that the clips stay the same


def make_batch(key: Array, textures: Textures, phase: Phase, frames: int) -> Batch:
    """Return the batch of a JAX random key: `phase.batch` clips of `frames` frames, in random order and colours.

    The clips have the phase's height and width; its further `sizes` are not read. In a share `phase.suppressed` of the
    clips, random regions are suppressed, in the same pairs of blocks. Pure; `phase` and `frames` are static.
    """
    config = phase.scenes(frames)

    def one(key: Array) -> tuple[SyntheticClip, Array | None]:
        scene_key, order_key, colour_key = jax.random.split(key, 3)
        clip = generate(scene_key, textures, config)
        shuffle_key, coin_key = jax.random.split(order_key)
        order = jax.random.permutation(shuffle_key, frames)
        order = jnp.where(jax.random.uniform(coin_key) < IN_ORDER, jnp.arange(frames), order)
        clip = jax.tree.map(lambda leaf: leaf[order], clip)
        clip = clip._replace(images=_recolour(colour_key, clip.images, phase.gamma))
        if not phase.suppressed:
            return clip, None
        region_key, coin_key = jax.random.split(jax.random.fold_in(key, _SUPPRESSION))
        regions = random_regions(region_key, frames, phase.height, phase.width)[order]
        return clip, regions & (jax.random.uniform(coin_key) < phase.suppressed)

    clips, regions = jax.vmap(one)(jax.random.split(key, phase.batch))
    if regions is None:
        return Batch(clips)
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
