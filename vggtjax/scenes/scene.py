"""Random scenes: a room, things that stand or move in it, materials, a light and a hand-held camera, from one key."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.errors import InputError

KINDS = ("box", "ellipsoid", "cylinder")
ROOM_FACES = 6
MATERIAL = 12  # tile, scale, cos, sin, offset (2), gain (3), saturation, contrast, roughness of shading
BODY = (("box", 1), ("ellipsoid", 1), ("cylinder", 4))  # parts of the articulated figure: torso, head, four limbs


@dataclass(frozen=True)
class SceneConfig:
    """What to draw and how. Static under jit.

    Attributes:
        height, width: of the images, in pixels.
        frames: at equal steps of the clip's time from 0 to 1.
        dynamic: share of clips in which one to three things move; False and True are 0 and 1.
        boxes, ellipsoids, cylinders: things in a scene besides the articulated figure; each is there or not.
        motion: range of the camera's share of its largest path.
        static_camera: share of clips whose camera stands still.
        field_of_view: range of the horizontal one, in degrees.
        samples: rays per pixel along each side, averaged in the image; truth is that of the pixel's centre.
        shutter: share of the time between frames that the shutter is open (motion blur), in `exposures` steps.
        noise: largest standard deviation of the sensor's noise.
        flicker: standard deviation of the logarithm of the exposure from frame to frame.
        frozen: what moves stands where it is in the middle of the clip; masks still name it.
    """

    height: int = 64
    width: int = 64
    frames: int = 4
    dynamic: float = 0.0
    boxes: int = 5
    ellipsoids: int = 2
    cylinders: int = 2
    motion: tuple[float, float] = (0.1, 1.0)
    static_camera: float = 0.05
    field_of_view: tuple[float, float] = (45.0, 75.0)
    samples: int = 1
    shutter: float = 0.0
    exposures: int = 1
    noise: float = 0.02
    flicker: float = 0.08
    frozen: bool = False

    def __post_init__(self) -> None:
        for name in ("motion", "field_of_view"):
            value = getattr(self, name)
            if not isinstance(value, list | tuple) or len(value) != 2:
                raise InputError(f"{name} is {value!r}; expected two numbers, the smaller first")
            object.__setattr__(self, name, tuple(value))
        for name, low, high in (
            ("height", 8, 2048),
            ("width", 8, 2048),
            ("frames", 1, 1000),
            ("samples", 1, 8),
            ("exposures", 1, 64),
            ("boxes", 1, 64),
            ("ellipsoids", 1, 64),
            ("cylinders", 1, 64),
        ):
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise InputError(f"{name} is {value!r}; expected a whole number from {low} to {high}")
        for name, low, high in (
            ("dynamic", 0, 1),
            ("static_camera", 0, 1),
            ("shutter", 0, 1),
            ("noise", 0, 1),
            ("flicker", 0, 1),
            ("motion", 0, 2),
            ("field_of_view", 10, 150),
        ):
            value = getattr(self, name)
            values = value if name in ("motion", "field_of_view") else (value,)
            numbers = all(isinstance(v, int | float) and low <= v <= high for v in values)
            if not numbers or sorted(values) != [*values]:
                raise InputError(f"{name} is {value!r}; expected {low} to {high}, of two numbers the smaller first")

        if type(self.frozen) is not bool:
            raise InputError(f"frozen is {self.frozen!r}; expected true or false")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Shape of every part: the articulated figure's first in each kind."""
        counts: dict[str, int] = dict(zip(KINDS, (self.boxes, self.ellipsoids, self.cylinders), strict=True))
        return tuple(kind for kind, parts in BODY for _ in range(parts + counts[kind]))

    @property
    def objects(self) -> tuple[int, ...]:
        """Object of every part, from 0; object 0 is the articulated figure."""
        result, following = [], 1
        for kind, parts in BODY:
            alone = self.kinds.count(kind) - parts
            result += [0] * parts + list(range(following, following + alone))
            following += alone
        return tuple(result)


class Wave(NamedTuple):
    """A smooth path: slope (t - 1/2) + amplitude sin(2 pi frequency t + phase), each component by itself."""

    slope: Float[Array, "... C"]
    amplitude: Float[Array, "... C"]
    frequency: Float[Array, "... C"]
    phase: Float[Array, "... C"]

    def at(self, time: Float[Array, ""]) -> Float[Array, "... C"]:
        return self.slope * (time - 0.5) + self.amplitude * jnp.sin(2 * jnp.pi * self.frequency * time + self.phase)


class Camera(NamedTuple):
    """A hand-held camera that looks at a wandering point: azimuth, elevation, log distance, roll; target; shake."""

    start: Float[Array, 4]
    orbit: Wave
    target: Wave
    shake: Wave
    distance: Float[Array, ""]
    half_angle: Float[Array, ""]  # of the horizontal field of view, radians


class Scene(NamedTuple):
    """All that a clip is drawn from. Metres, y down; the point of interest is the origin."""

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
    material: Float[Array, "M 12"]  # parts, then the room's faces
    light: Float[Array, 3]
    ambient: Float[Array, ""]
    camera: Camera
    exposure: Wave  # of the three channels, logarithm
    noise: Float[Array, ""]


class _Dice:
    """Uniform numbers from one draw: compiling one generator is far cheaper than compiling fifty."""

    def __init__(self, key: Array, count: int) -> None:
        self._numbers = jax.random.uniform(key, (count,))
        self._used = 0

    def __call__(self, low: float | Array, high: float | Array, *shape: int) -> Array:
        count = math.prod(shape)
        numbers = self._numbers[self._used : self._used + count]
        self._used += count
        if self._used > len(self._numbers):
            raise ValueError("the scene's draw is too short")
        return low + (high - low) * numbers.reshape(shape)


def sample_scene(key: Array, tiles: int, config: SceneConfig) -> Scene:
    """Draw a scene. Pure; `config` is static.

    Args:
        key: a JAX random key.
        tiles: number of texture tiles.
        config: what may be in it.
    """
    kinds, objects = config.kinds, np.asarray(config.objects)
    K, count = len(kinds), max(config.objects) + 1
    dice = _Dice(key, 40 * K + 40 * count + 400)
    distance = dice(2.0, 5.0)
    azimuth = dice(-jnp.pi, jnp.pi)
    floor, ceiling = distance * dice(0.25, 0.45), -distance * dice(0.6, 1.3)
    camera = _camera(dice, distance, azimuth, config)

    # Objects in front of the camera's path stay within 0.55 of its distance; behind, they spread out to the walls.
    angle = dice(-jnp.pi, jnp.pi, count)
    behind = jnp.cos(angle) < 0.2  # seen from the camera, on the far side
    radius = distance * jnp.where(behind, dice(0.1, 1.2, count), dice(0.1, 0.5, count))
    aspect = dice(0.5, 1.6, K, 3)
    size = distance * dice(0.05, 0.2, K, 1) * aspect
    round_ = np.asarray([kind == "cylinder" for kind in kinds])
    size = jnp.where(round_[:, None], size[:, jnp.asarray([0, 1, 0])] * jnp.asarray([0.7, 1.5, 0.7])[None], size)
    present = dice(0.0, 1.0, K) < 0.85

    # The figure: torso, head, two legs and two arms that swing about hips and shoulders.
    body = [i for i, o in enumerate(objects) if o == 0]
    torso, head, *limbs = body
    tall = distance * dice(0.09, 0.17)
    proportions = np.zeros((K, 3))
    joints, arms, swings = np.zeros((K, 3)), np.zeros((K, 3)), np.zeros((K, 2))  # swing: share, phase
    proportions[torso], proportions[head] = (0.42, 0.7, 0.3), (0.3, 0.36, 0.3)
    arms[head] = (0, -1.05, 0)
    for limb, (side, leg) in zip(limbs, [(-1, 1), (1, 1), (-1, 0), (1, 0)], strict=True):
        proportions[limb] = (0.17, 0.55, 0.17) if leg else (0.12, 0.5, 0.12)
        joints[limb] = (0.25 * side, 0.7, 0) if leg else (0.56 * side, -0.6, 0)
        arms[limb] = (0, 0.55, 0) if leg else (0, 0.5, 0)
        swings[limb] = (1, np.pi * (side * (1 if leg else -1) > 0))
    in_body = (objects == 0)[:, None]
    size = jnp.where(in_body, tall * proportions, size)
    present = jnp.where(in_body[:, 0], dice(0.0, 1.0) < 0.6, present)

    half_height = jnp.zeros(count).at[objects].max(size[:, 1])
    half_height = half_height.at[0].set(1.8 * tall)
    hung = dice(0.0, 1.0, count) < jnp.where(np.arange(count) == 0, 0.0, 0.25)
    height = jnp.where(hung, dice(-0.35, 0.1, count) * distance, floor - half_height)
    position = jnp.stack([radius * jnp.sin(angle + azimuth), height, -radius * jnp.cos(angle + azimuth)], axis=-1)
    tilt = _rotation_y(dice(-jnp.pi, jnp.pi, K)) @ _rotation_x(
        jnp.where(jnp.asarray(hung)[objects], dice(-1.0, 1.0, K), 0.0)
    )
    tilt = jnp.where(in_body[..., None], jnp.eye(3)[None], tilt)

    # Movers: at most three, of those that are there; bounded paths over the floor, hops, turns.
    order = jnp.argsort(jnp.where(jnp.zeros(count, bool).at[objects].max(present), dice(0.0, 1.0, count), 2.0))
    rank = jnp.zeros(count, jnp.int32).at[order].set(jnp.arange(count, dtype=jnp.int32))
    moving = (rank < 1 + jnp.floor(dice(0.0, 3.0))) & (dice(0.0, 1.0) < config.dynamic)
    centre = distance * dice(-0.2, 0.2, count, 2)
    reach = distance * dice(0.05, 0.3, count, 2)
    position = jnp.where(moving[:, None], jnp.stack([centre[:, 0], height, centre[:, 1]], axis=-1), position)
    hop = jnp.where(hung, 0.08 * distance, 0.03 * distance) * dice(0.0, 1.0, count)
    amplitude = jnp.stack([reach[:, 0], hop, reach[:, 1], dice(0.0, 0.6, count)], axis=-1)
    slope = jnp.concatenate(
        [distance * dice(-0.25, 0.25, count, 3) * np.array([[1, 0, 1]]), dice(-2.0, 2.0, count, 1)], -1
    )
    frequency = dice(0.3, 1.3, count, 4) * np.array([[1, 2, 1, 1]])
    path = Wave(slope, amplitude, frequency, dice(-jnp.pi, jnp.pi, count, 4))
    path = Wave(*(jnp.where(moving[:, None], part, 0) for part in path))
    walking = moving[0] * dice(0.3, 0.9)
    swing = Wave(
        jnp.zeros((K, 1)),
        jnp.asarray(swings[:, :1]) * walking,
        jnp.full((K, 1), 1.0) * dice(1.0, 3.0),
        jnp.asarray(swings[:, 1:]) + dice(-jnp.pi, jnp.pi),
    )

    wide = distance * dice(1.3, 2.6, 2, 2)
    room_low = jnp.stack([-wide[0, 0], ceiling, -wide[0, 1]])
    room_high = jnp.stack([wide[1, 0], floor, wide[1, 1]])
    light = jnp.stack([0.6 * wide[0, 0], ceiling, 0.6 * wide[0, 1]]) * dice(-0.9, 0.9, 3)
    light = light.at[1].set(0.8 * ceiling)
    return Scene(
        size=size,
        present=present,
        moving=moving,
        position=position,
        heading=dice(-jnp.pi, jnp.pi, count),
        path=path,
        joint=tall * joints.astype(np.float32),
        arm=tall * arms.astype(np.float32),
        swing=swing,
        tilt=tilt,
        room_low=room_low,
        room_high=room_high,
        material=_materials(dice, tiles, distance, K),
        light=light,
        ambient=dice(0.35, 0.7),
        camera=camera,
        exposure=Wave(
            jnp.zeros(3),
            config.flicker * jnp.ones(3) * dice(0.0, 1.5) + 0.2 * config.flicker * dice(-1.0, 1.0, 3),
            dice(0.3, 3.0) * jnp.ones(3),
            dice(-jnp.pi, jnp.pi) * jnp.ones(3),
        ),
        noise=config.noise * dice(0.0, 1.0),
    )


def part_poses(scene: Scene, config: SceneConfig, time: Float[Array, ""]) -> tuple[Array, Array]:
    """Return rotation [K, 3, 3] and centre [K, 3] of every part in the world at a time; the clip lasts from 0 to 1."""
    objects = np.asarray(config.objects)
    time = jnp.float32(0.5) if config.frozen else time
    moved = scene.path.at(time)  # [O, 4]
    heading = _rotation_y(scene.heading + moved[:, 3])[objects]
    swing = _rotation_x(scene.swing.at(time)[:, 0])
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
    cos, sin = jnp.cos(roll), jnp.sin(roll)
    return jnp.stack([cos * right + sin * down, cos * down - sin * right, forward], axis=-1), centre


def _camera(dice: _Dice, distance: Array, azimuth: Array, config: SceneConfig) -> Camera:
    still = dice(0.0, 1.0) < config.static_camera
    share = jnp.where(still, 0.0, dice(*config.motion))
    moving = jnp.where(still, 0.0, 1.0)
    # From a walk around a thing to a pan on the spot: the larger of the two motions takes the whole share.
    mixed = dice(0.0, 1.0, 2)
    walk, pan = share * mixed / mixed.max()
    signs = jnp.sign(dice(-1.0, 1.0, 4))
    orbit = Wave(
        walk * signs * jnp.asarray([0.55, 0.12, 0.25, 0.12]) * dice(0.2, 1.0, 4),
        walk * jnp.asarray([0.2, 0.12, 0.12, 0.06]) * dice(0.2, 1.0, 4),
        dice(0.5, 1.3, 4),
        dice(-jnp.pi, jnp.pi, 4),
    )
    target = Wave(
        pan * distance * dice(-0.5, 0.5, 3),
        pan * distance * dice(0.0, 0.2, 3),
        dice(0.4, 1.2, 3),
        dice(-jnp.pi, jnp.pi, 3),
    )
    shake = Wave(jnp.zeros(3), moving * distance * dice(0.0, 0.012, 3), dice(2.0, 5.0, 3), dice(-jnp.pi, jnp.pi, 3))
    start = jnp.stack([azimuth, dice(-0.05, 0.3), dice(-0.05, 0.05), dice(-0.08, 0.08)])
    low, high = config.field_of_view
    return Camera(start, orbit, target, shake, distance, jnp.deg2rad(dice(low, high)) / 2)


def _materials(dice: _Dice, tiles: int, distance: Array, parts: int) -> Float[Array, "M 12"]:
    count = parts + ROOM_FACES
    tile = jnp.floor(dice(0.0, tiles, count))
    part = np.arange(count) < parts
    repeat = jnp.where(part, dice(0.8, 3.0, count), dice(0.2, 0.8, count)) / distance * 2  # tiles per metre
    turn = dice(-jnp.pi, jnp.pi, count)
    gain = dice(0.55, 1.35, count, 3)
    return jnp.stack(
        [
            tile,
            repeat,
            jnp.cos(turn),
            jnp.sin(turn),
            dice(0.0, 2.0, count),
            dice(0.0, 2.0, count),
            *gain.T,
            dice(0.2, 1.5, count),
            dice(0.7, 1.4, count),
            dice(0.5, 1.0, count),
        ],
        axis=-1,
    )


def _rotation_y(angle: Float[Array, " N"]) -> Float[Array, "N 3 3"]:
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 3, 3)


def _rotation_x(angle: Float[Array, " N"]) -> Float[Array, "N 3 3"]:
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c], axis=-1).reshape(-1, 3, 3)
