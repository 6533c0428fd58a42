"""Paths over a clip's seconds: where an actor stands and turns, where the camera is and looks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from vggtjax.training.world.meshes import Mesh

STEPS = 65  # points of a path, at equal steps of time; between them it is straight


class Actor(NamedTuple):
    """A thing that moves: its mesh in every pose of its gait, and its place and turn along the path."""

    mesh: Mesh
    poses: Float[np.ndarray, "T V 3"]
    rate: float  # poses a second
    phase: float  # pose at time 0
    seconds: float
    place: Float[np.ndarray, "N 3"]
    turn: Float[np.ndarray, "N 3"]  # about z, then y, then x; radians

    def vertices(self, time: float) -> Float[np.ndarray, "V 3"]:
        """Return the world's positions of the vertices at a time in seconds."""
        pose = (self.phase + self.rate * time) % len(self.poses)
        low = int(pose) % len(self.poses)
        share = np.asarray(pose - low, np.float32)
        body = self.poses[low] * (1 - share) + self.poses[(low + 1) % len(self.poses)] * share
        rotation = turned(along(self.turn, time / self.seconds))
        return (body @ rotation.T + along(self.place, time / self.seconds)).astype(np.float32)


class CameraPath(NamedTuple):
    """A camera: its centre, the point it looks at, and what a hand adds, as angles about right, down and forward."""

    seconds: float
    centre: Float[np.ndarray, "N 3"]
    target: Float[np.ndarray, "N 3"]
    shake: Float[np.ndarray, "N 3"]

    def pose(self, time: float) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
        """Return world_from_camera at a time in seconds: rotation (columns right, down, forward) and centre."""
        share = time / self.seconds
        centre = along(self.centre, share)
        forward = along(self.target, share) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= max(np.linalg.norm(right), 1e-6)
        frame = np.stack([right, np.cross(forward, right), forward], axis=-1)
        x, y, z = along(self.shake, share)
        return frame @ _about(1, y) @ _about(0, x) @ _about(2, z), centre


def along(values: Float[np.ndarray, "N C"], share: float) -> Float[np.ndarray, " C"]:
    """Return a path's value at a share of the clip; beyond its ends it goes on straight."""
    position = share * (len(values) - 1)
    low = int(np.clip(np.floor(position), 0, len(values) - 2))
    return values[low] + (position - low) * (values[low + 1] - values[low])


def turned(angles: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about z, then y, then x."""
    return _about(2, angles[0]) @ _about(1, angles[1]) @ _about(0, angles[2])


def wander(
    generator: np.random.Generator, amplitude: float, seconds: float, slowest: float, fastest: float, count: int
) -> Float[np.ndarray, "N C"]:
    """Return `count` smooth random signals, with frequencies in a range of hertz, of a size up to three `amplitude`."""
    times = np.linspace(0, seconds, STEPS)[:, None]
    signal = np.zeros((STEPS, count))
    for _ in range(3):
        frequency = np.exp(generator.uniform(np.log(slowest), np.log(fastest), count))
        size = generator.uniform(0, 1, count) * np.sqrt(slowest / frequency)
        signal += size * np.sin(2 * np.pi * frequency * times + generator.uniform(0, 2 * np.pi, count))
    return amplitude * signal


def _about(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix
