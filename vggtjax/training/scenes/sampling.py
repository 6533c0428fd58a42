"""Random scenes: every size, place, path, material and light of a scene, drawn from one key."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.scenes.scene import ROOM_FACES, Camera, Scene, Wave, rotation_x, rotation_y

# The figure's torso, head, legs and arms, in units of its size: half extents, joint, arm from the joint to the part's
# centre, then the share and the phase of the swing about the joint.
_FIGURE = np.array(
    [
        (0.42, 0.7, 0.3, 0, 0, 0, 0, 0, 0, 0, 0),
        (0.3, 0.36, 0.3, 0, 0, 0, 0, -1.05, 0, 0, 0),
        (0.17, 0.55, 0.17, -0.25, 0.7, 0, 0, 0.55, 0, 1, 0),
        (0.17, 0.55, 0.17, 0.25, 0.7, 0, 0, 0.55, 0, 1, np.pi),
        (0.12, 0.5, 0.12, -0.56, -0.6, 0, 0, 0.5, 0, 1, np.pi),
        (0.12, 0.5, 0.12, 0.56, -0.6, 0, 0, 0.5, 0, 1, 0),
    ]
)


class _Draws:
    """Uniform numbers from one random call: compiling one generator is far cheaper than compiling fifty.

    The order of the calls decides every scene of every seed: do not change it.
    """

    def __init__(self, key: Array, count: int) -> None:
        self._numbers = jax.random.uniform(key, (count,))
        self._used = 0

    def __call__(self, low: float | Array, high: float | Array, *shape: int) -> Array:
        count = math.prod(shape)
        numbers = self._numbers[self._used : self._used + count]
        self._used += count
        if self._used > len(self._numbers):
            raise ValueError("the scene needs more random numbers than were drawn")
        return low + (high - low) * numbers.reshape(shape)


def sample_scene(key: Array, tiles: int, config: SceneConfig) -> Scene:
    """Draw a scene from a JAX random key and a number of texture tiles. Pure; `config` is static."""
    objects = np.asarray(config.objects)
    K, count = len(objects), max(config.objects) + 1
    draw = _Draws(key, 40 * K + 40 * count + 400)
    distance = draw(2.0, 5.0)
    azimuth = draw(-jnp.pi, jnp.pi)
    floor, ceiling = distance * draw(0.25, 0.45), -distance * draw(0.6, 1.3)
    camera = _camera(draw, distance, azimuth, config)
    x, z = _ground(draw, count, distance, azimuth)
    size, present = _parts(draw, config.kinds, distance)

    figure = np.zeros((K, _FIGURE.shape[1]))
    figure[objects == 0] = _FIGURE
    proportions, joint, arm, swing = np.split(figure, (3, 6, 9), axis=1)
    in_figure = objects == 0
    tall = distance * draw(0.09, 0.17)
    size = jnp.where(in_figure[:, None], tall * proportions, size)
    present = jnp.where(in_figure, draw(0.0, 1.0) < 0.6, present)

    half_height = jnp.zeros(count).at[objects].max(size[:, 1]).at[0].set(1.8 * tall)
    hangs = draw(0.0, 1.0, count) < jnp.where(np.arange(count) == 0, 0.0, 0.25)
    height = jnp.where(hangs, draw(-0.35, 0.1, count) * distance, floor - half_height)
    tilt = rotation_y(draw(-jnp.pi, jnp.pi, K)) @ rotation_x(jnp.where(hangs[objects], draw(-1.0, 1.0, K), 0.0))
    moving = _moving(draw, jnp.zeros(count, bool).at[objects].max(present), config.dynamic)
    centre, path = _path(draw, moving, hangs, distance)
    position = jnp.where(
        moving[:, None], jnp.stack([centre[:, 0], height, centre[:, 1]], axis=-1), jnp.stack([x, height, z], axis=-1)
    )
    swing = _swing(draw, swing, moving[0])
    room_low, room_high, light = _room(draw, distance, floor, ceiling)
    return Scene(
        size=size,
        present=present,
        moving=moving,
        position=position,
        heading=draw(-jnp.pi, jnp.pi, count),
        path=path,
        joint=tall * joint.astype(np.float32),
        arm=tall * arm.astype(np.float32),
        swing=swing,
        tilt=jnp.where(in_figure[:, None, None], jnp.eye(3)[None], tilt),
        room_low=room_low,
        room_high=room_high,
        material=_materials(draw, tiles, distance, K),
        light=light,
        ambient=draw(0.35, 0.7),
        exposure=_exposure(draw, config.flicker),
        noise=config.noise * draw(0.0, 1.0),
        camera=_tilted(draw, camera, config),  # the last draws: scenes without a tilt are older
    )


def _camera(draw: _Draws, distance: Array, azimuth: Array, config: SceneConfig) -> Camera:
    still = draw(0.0, 1.0) < config.static_camera
    share = jnp.where(still, 0.0, draw(*config.motion))
    moving = jnp.where(still, 0.0, 1.0)
    # From a walk around an object to a pan on the spot: the larger of the two motions takes the whole share.
    mixed = draw(0.0, 1.0, 2)
    walk, pan = share * mixed / mixed.max()
    signs = jnp.sign(draw(-1.0, 1.0, 4))
    orbit = Wave(
        walk * signs * jnp.asarray([0.55, 0.12, 0.25, 0.12]) * draw(0.2, 1.0, 4),
        walk * jnp.asarray([0.2, 0.12, 0.12, 0.06]) * draw(0.2, 1.0, 4),
        draw(0.5, 1.3, 4),
        draw(-jnp.pi, jnp.pi, 4),
    )
    target = Wave(
        pan * distance * draw(-0.5, 0.5, 3),
        pan * distance * draw(0.0, 0.2, 3),
        draw(0.4, 1.2, 3),
        draw(-jnp.pi, jnp.pi, 3),
    )
    shake = Wave(jnp.zeros(3), moving * distance * draw(0.0, 0.012, 3), draw(2.0, 5.0, 3), draw(-jnp.pi, jnp.pi, 3))
    start = jnp.stack([azimuth, draw(-0.05, 0.3), draw(-0.05, 0.05), draw(-0.08, 0.08)])
    low, high = config.field_of_view
    return Camera(start, orbit, target, shake, distance, jnp.deg2rad(draw(low, high)) / 2, jnp.zeros(()))


def _tilted(draw: _Draws, camera: Camera, config: SceneConfig) -> Camera:
    low, high = config.pitch
    pitch, roll = jnp.deg2rad(draw(low, high)), jnp.deg2rad(draw(-config.roll, config.roll))
    return camera._replace(start=camera.start.at[3].add(roll), pitch=pitch)


def _ground(draw: _Draws, count: int, distance: Array, azimuth: Array) -> tuple[Float[Array, " O"], Float[Array, " O"]]:
    """Return x and z of objects: in front of the camera's path within half its distance, behind it up to the walls."""
    angle = draw(-jnp.pi, jnp.pi, count)
    behind = jnp.cos(angle) < 0.2  # on the far side as the camera sees it
    radius = distance * jnp.where(behind, draw(0.1, 1.2, count), draw(0.1, 0.5, count))
    return radius * jnp.sin(angle + azimuth), -radius * jnp.cos(angle + azimuth)


def _parts(draw: _Draws, kinds: tuple[str, ...], distance: Array) -> tuple[Float[Array, "K 3"], Bool[Array, " K"]]:
    """Return the half extents of the parts, and which parts are present; cylinders are round and tall."""
    K = len(kinds)
    aspect = draw(0.5, 1.6, K, 3)
    size = distance * draw(0.05, 0.2, K, 1) * aspect
    is_cylinder = np.asarray([kind == "cylinder" for kind in kinds])[:, None]
    size = jnp.where(is_cylinder, size[:, jnp.asarray([0, 1, 0])] * jnp.asarray([0.7, 1.5, 0.7])[None], size)
    return size, draw(0.0, 1.0, K) < 0.85


def _moving(draw: _Draws, present: Bool[Array, " O"], dynamic: float) -> Bool[Array, " O"]:
    """Return which objects move: one to three of those present, in a share `dynamic` of scenes."""
    count = len(present)
    order = jnp.argsort(jnp.where(present, draw(0.0, 1.0, count), 2.0))
    rank = jnp.zeros(count, jnp.int32).at[order].set(jnp.arange(count, dtype=jnp.int32))
    return (rank < 1 + jnp.floor(draw(0.0, 3.0))) & (draw(0.0, 1.0) < dynamic)


def _path(
    draw: _Draws, moving: Bool[Array, " O"], hangs: Bool[Array, " O"], distance: Array
) -> tuple[Float[Array, "O 2"], Wave]:
    """Return x and z of the centre of each path, and bounded paths [O, 4] over the floor, with hops and turns."""
    count = len(moving)
    centre = distance * draw(-0.2, 0.2, count, 2)
    reach = distance * draw(0.05, 0.3, count, 2)
    hop = jnp.where(hangs, 0.08 * distance, 0.03 * distance) * draw(0.0, 1.0, count)
    amplitude = jnp.stack([reach[:, 0], hop, reach[:, 1], draw(0.0, 0.6, count)], axis=-1)
    travel = distance * draw(-0.25, 0.25, count, 3) * np.array([[1, 0, 1]])
    slope = jnp.concatenate([travel, draw(-2.0, 2.0, count, 1)], axis=-1)
    frequency = draw(0.3, 1.3, count, 4) * np.array([[1, 2, 1, 1]])
    path = Wave(slope, amplitude, frequency, draw(-jnp.pi, jnp.pi, count, 4))
    return centre, Wave(*(jnp.where(moving[:, None], part, 0) for part in path))


def _swing(draw: _Draws, swing: np.ndarray, walks: Bool[Array, ""]) -> Wave:
    """Return the angle of each part about its joint, [K, 1]; `swing` [K, 2] holds shares and phases."""
    share, phase = np.split(swing, 2, axis=1)
    amplitude = jnp.asarray(share) * (walks * draw(0.3, 0.9))
    still = jnp.zeros(share.shape)
    return Wave(still, amplitude, (still + 1) * draw(1.0, 3.0), jnp.asarray(phase) + draw(-jnp.pi, jnp.pi))


def _room(draw: _Draws, distance: Array, floor: Array, ceiling: Array) -> tuple[Array, Array, Array]:
    """Return the room's lower and upper corner, and the light's position below the ceiling."""
    wide = distance * draw(1.3, 2.6, 2, 2)
    low = jnp.stack([-wide[0, 0], ceiling, -wide[0, 1]])
    high = jnp.stack([wide[1, 0], floor, wide[1, 1]])
    light = jnp.stack([0.6 * wide[0, 0], ceiling, 0.6 * wide[0, 1]]) * draw(-0.9, 0.9, 3)
    return low, high, light.at[1].set(0.8 * ceiling)


def _materials(draw: _Draws, tiles: int, distance: Array, parts: int) -> Float[Array, "M 12"]:
    count = parts + ROOM_FACES
    tile = jnp.floor(draw(0.0, tiles, count))
    is_part = np.arange(count) < parts
    repeat = jnp.where(is_part, draw(0.8, 3.0, count), draw(0.2, 0.8, count)) / distance * 2  # tiles per metre
    turn = draw(-jnp.pi, jnp.pi, count)
    gain = draw(0.55, 1.35, count, 3)
    ranges = (0.0, 2.0), (0.0, 2.0), (0.2, 1.5), (0.7, 1.4), (0.5, 1.0)
    u, v, saturation, contrast, roughness = (draw(low, high, count) for low, high in ranges)
    columns = [tile, repeat, jnp.cos(turn), jnp.sin(turn), u, v, *gain.T, saturation, contrast, roughness]
    return jnp.stack(columns, axis=-1)


def _exposure(draw: _Draws, flicker: float) -> Wave:
    """Return the logarithm of the exposure of the three channels."""
    amplitude = flicker * jnp.ones(3) * draw(0.0, 1.5) + 0.2 * flicker * draw(-1.0, 1.0, 3)
    return Wave(jnp.zeros(3), amplitude, draw(0.3, 3.0) * jnp.ones(3), draw(-jnp.pi, jnp.pi) * jnp.ones(3))
