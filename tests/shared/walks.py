"""Long walks through a scene: the camera goes around its middle and comes back to where it began."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from vggtjax.training.scenes.scene import Scene, Wave

_AROUND = 0.45  # share of their distance from the middle that objects keep: none stands on the camera's way
_SWAY = np.array([0.0, 0.05, 0.08, 0.03])  # of elevation, logarithm of distance and roll, on top of the way around


def closed_walk(scene: Scene, *, laps: float = 1.0, pace: float = 1.0) -> Scene:
    """Return the scene with a camera that walks around its middle, so that the way closes; objects keep to the middle.

    Args:
        scene: of `sample_scene`.
        laps: ways around in the clip.
        pace: how many times faster objects move, in rounded paths: a long clip shows more of their way.
    """
    camera, count = scene.camera, len(scene.moving)
    still = jnp.zeros(4)
    whole = jnp.asarray([1.0, 2.0, 3.0, 2.0])  # waves in a lap: the sway closes too
    orbit = Wave(
        still.at[0].set(2 * np.pi * laps),
        jnp.asarray(_SWAY, jnp.float32),
        laps * whole,
        jnp.asarray([0.0, 0.5, 1.0, 2.0]),
    )
    target = Wave(jnp.zeros(3), camera.distance * 0.1 * jnp.asarray([1.0, 0.3, 1.0]), laps * whole[:3], jnp.zeros(3))
    shake = camera.shake._replace(amplitude=0.3 * camera.shake.amplitude, frequency=jnp.round(40 * laps * whole[:3]))
    ground = jnp.asarray([_AROUND, 1.0, _AROUND])
    path = scene.path._replace(
        slope=jnp.zeros((count, 4)),
        amplitude=scene.path.amplitude * jnp.asarray([[2 * _AROUND, 1.0, 2 * _AROUND, 1.0]]),
        frequency=pace * scene.path.frequency,
    )
    return scene._replace(
        camera=camera._replace(orbit=orbit, target=target, shake=shake, start=camera.start.at[2].set(0.0)),
        position=scene.position * ground[None],
        path=path,
        swing=scene.swing._replace(frequency=pace * scene.swing.frequency),
    )
