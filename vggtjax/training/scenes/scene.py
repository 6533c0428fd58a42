"""A scene and its motion: a room with objects, materials, a light and a hand-held camera."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.training.scenes.config import SceneConfig

ROOM_FACES = 6


class Wave(NamedTuple):
    """A smooth path: slope (t - 1/2) + amplitude sin(2 pi frequency t + phase), for each component."""

    slope: Float[Array, "... C"]
    amplitude: Float[Array, "... C"]
    frequency: Float[Array, "... C"]
    phase: Float[Array, "... C"]

    def at(self, time: Float[Array, ""]) -> Float[Array, "... C"]:
        return self.slope * (time - 0.5) + self.amplitude * jnp.sin(2 * jnp.pi * self.frequency * time + self.phase)


class Camera(NamedTuple):
    """A hand-held camera and its wandering target; `start` and `orbit` hold azimuth, elevation, log distance, roll.

    The camera looks by `pitch` below the target.
    """

    start: Float[Array, 4]
    orbit: Wave
    target: Wave
    shake: Wave
    distance: Float[Array, ""]
    half_angle: Float[Array, ""]  # of the horizontal field of view, radians
    pitch: Float[Array, ""]  # radians


class Scene(NamedTuple):
    """The content of a clip. Metres, y down; the origin is the point of interest."""

    size: Float[Array, "K 3"]
    present: Bool[Array, " K"]
    moving: Bool[Array, " O"]
    position: Float[Array, "O 3"]
    heading: Float[Array, " O"]
    path: Wave  # of each object, [O, 4]: position and heading
    joint: Float[Array, "K 3"]  # of each part, in its object's frame
    arm: Float[Array, "K 3"]  # from the joint to the part's centre
    swing: Wave  # angle of each part about its joint, [K, 1]
    tilt: Float[Array, "K 3 3"]  # fixed rotation of each part
    room_low: Float[Array, 3]
    room_high: Float[Array, 3]
    # Parts, then the room's faces: tile, scale, cos, sin, offset (2), gain (3), saturation, contrast, roughness.
    material: Float[Array, "M 12"]
    light: Float[Array, 3]
    ambient: Float[Array, ""]
    camera: Camera
    exposure: Wave  # of the three channels, logarithm
    noise: Float[Array, ""]


def part_poses(scene: Scene, config: SceneConfig, time: Float[Array, ""]) -> tuple[Array, Array]:
    """Return rotation [K, 3, 3] and centre [K, 3] of every part in the world at a time; the clip lasts from 0 to 1."""
    objects = np.asarray(config.objects)
    time = jnp.float32(0.5) if config.frozen else time
    moved = scene.path.at(time)  # [O, 4]
    heading = rotation_y(scene.heading + moved[:, 3])[objects]
    swing = rotation_x(scene.swing.at(time)[:, 0])
    rotation = heading @ swing
    offset = scene.joint + jnp.einsum("kij,kj->ki", swing, scene.arm)
    centre = (scene.position + moved[:, :3])[objects] + jnp.einsum("kij,kj->ki", heading, offset)
    return rotation @ scene.tilt, centre


def camera_pose(camera: Camera, time: Float[Array, ""]) -> tuple[Float[Array, "3 3"], Float[Array, 3]]:
    """Return world_from_camera at a time: rotation (columns right, down, forward) and centre."""
    azimuth, elevation, log_distance, roll = camera.start + camera.orbit.at(time)
    distance = camera.distance * jnp.exp(log_distance)
    flat = jnp.cos(elevation)
    centre = distance * jnp.stack([jnp.sin(azimuth) * flat, -jnp.sin(elevation), -jnp.cos(azimuth) * flat])
    centre = centre + camera.shake.at(time)
    forward = camera.target.at(time) - centre
    forward = forward / jnp.linalg.norm(forward)
    right = jnp.cross(jnp.asarray([0.0, 1.0, 0.0]), forward)
    right = right / jnp.linalg.norm(right)
    down = jnp.cross(forward, right)
    cos, sin = jnp.cos(camera.pitch), jnp.sin(camera.pitch)
    forward, down = cos * forward + sin * down, cos * down - sin * forward
    cos, sin = jnp.cos(roll), jnp.sin(roll)
    return jnp.stack([cos * right + sin * down, cos * down - sin * right, forward], axis=-1), centre


def rotation_y(angle: Float[Array, " N"]) -> Float[Array, "N 3 3"]:
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 3, 3)


def rotation_x(angle: Float[Array, " N"]) -> Float[Array, "N 3 3"]:
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c], axis=-1).reshape(-1, 3, 3)


def invert(pose: Float[Array, "*B 3 4"]) -> Float[Array, "*B 3 4"]:
    """Return the inverse of rigid transforms."""
    rotation = pose[..., :3].swapaxes(-1, -2)
    return jnp.concatenate([rotation, -rotation @ pose[..., 3:]], axis=-1)


def compose(a: Float[Array, "*B 3 4"], b: Float[Array, "*B 3 4"]) -> Float[Array, "*B 3 4"]:
    """Return the rigid transforms that apply `b`, then `a`."""
    return jnp.concatenate([a[..., :3] @ b[..., :3], a[..., :3] @ b[..., 3:] + a[..., 3:]], axis=-1)
