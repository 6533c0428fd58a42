"""Small generated clips for tests, compiled once a process, and what a slow look at a scene needs."""

import functools

import jax
import numpy as np

from vggtjax.training.scenes import Scene, SceneConfig, SyntheticClip, Textures, generate, load_textures, sample_scene

DYNAMIC = SceneConfig(height=32, width=48, frames=4, dynamic=1.0)
STATIC = SceneConfig(height=32, width=48, frames=4, dynamic=0.0)
QUICK = {"xla_backend_optimization_level": 0}  # compiles in half the time, where speed is all that the compiler is for


@functools.cache
def textures() -> Textures:
    """Return the tiles of the training split."""
    return load_textures("training")


def keys(count: int) -> jax.Array:
    """Return keys of which the first ones are always the same."""
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(0), i))(np.arange(count))


@functools.cache
def clips(config: SceneConfig, count: int) -> SyntheticClip:
    """Return clips of the first keys, [count, S, ...] numpy."""
    options = None if config == DYNAMIC else QUICK

    def make(keys: jax.Array, textures: Textures) -> SyntheticClip:
        return jax.vmap(lambda key: generate(key, textures, config))(keys)

    return jax.device_get(jax.jit(make, compiler_options=options)(keys(count), textures()))


@functools.cache
def scenes(config: SceneConfig, count: int) -> Scene:
    """Return the scenes behind `clips`."""
    tiles = textures().tiles
    return jax.jit(jax.vmap(lambda key: sample_scene(jax.random.split(key)[0], tiles, config)))(keys(count))


def gauge(kind: str, points: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return how far out points [..., 3] lie in a part's axes: 1 on its surface, below 1 inside."""
    share = np.abs(points) / size
    if kind == "box":
        return share.max(axis=-1)
    if kind == "ellipsoid":
        return np.sqrt((share**2).sum(axis=-1))
    return np.maximum(np.hypot(share[..., 0], share[..., 2]), share[..., 1])
