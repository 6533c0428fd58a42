"""Ray casting: a scene at a time, seen from its camera -> image, depth, parts and motion of every point."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.network.precision import full_precision
from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.scenes.sampling import sample_scene
from vggtjax.training.scenes.scene import ROOM_FACES, Scene, camera_pose, compose, invert, part_poses
from vggtjax.training.scenes.shapes import SHAPES, slabs
from vggtjax.training.scenes.textures import Textures, sample

_SELF = 1e-3  # share of the ray to the light in which a surface does not shade itself


class SyntheticClip(NamedTuple):
    """A clip and its truth. OpenCV cameras, metres; the world's axes are the scene's (y down)."""

    images: Float[Array, "*B S H W 3"]  # RGB in [0, 1]
    depth: Float[Array, "*B S H W"]  # along z
    object_ids: Int[Array, "*B S H W"]  # 0 is the room
    part_ids: Int[Array, "*B S H W"]  # 0 is the room; every rigid part has its own number
    dynamic_mask: Bool[Array, "*B S H W"]
    scene_flow: Float[Array, "*B S H W 3"]  # world axes: the pixel's point a frame later, minus the point
    camera_from_world: Float[Array, "*B S 3 4"]
    intrinsics: Float[Array, "*B S 3 3"]
    world_from_part: Float[Array, "*B S K 3 4"]  # indexed by part_ids; row 0 is the identity


class Surface(NamedTuple):
    """The first hits of rays."""

    depth: Float[Array, " P"]
    part_ids: Int[Array, " P"]
    point: Float[Array, "3 P"]
    colour: Float[Array, "3 P"]


@full_precision()
def generate(key: Array, textures: Textures, config: SceneConfig) -> SyntheticClip:
    """Return the clip of a key. Pure: jit with `config` static, vmap over keys.

    The same key and textures give the same clip, whatever the batch.
    """
    scene_key, noise_key = jax.random.split(key)
    return render(sample_scene(scene_key, textures.tiles, config), noise_key, textures, config)


@full_precision()
def render(scene: Scene, noise_key: Array, textures: Textures, config: SceneConfig) -> SyntheticClip:
    """Return the clip of a scene, with noise of a key. Pure: jit with `config` static."""
    step = 1 / max(config.frames - 1, 1)
    times = jnp.asarray(np.arange(config.frames, dtype=np.float32) * np.float32(step))
    clip = jax.lax.map(lambda time: _frame(scene, textures, config, time, step), times)
    noise = scene.noise * jax.random.normal(noise_key, clip.images.shape)
    return clip._replace(images=jnp.clip(clip.images + noise, 0, 1))


def intrinsics_of(scene: Scene, config: SceneConfig) -> Float[Array, "3 3"]:
    """Return the camera's intrinsics in pixels: square pixels, principal point at the image centre."""
    focal = config.width / 2 / jnp.tan(scene.camera.half_angle)
    return jnp.array([[focal, 0, config.width / 2], [0, focal, config.height / 2], [0, 0, 1]])


@full_precision()
def cast(
    scene: Scene, textures: Textures, config: SceneConfig, time: Float[Array, ""], pixels: Float[Array, "P 2"]
) -> Surface:
    """Return the surfaces that the camera at `time` sees at image positions (x, y) in pixels; centres are at + 0.5."""
    rotation, origin = camera_pose(scene.camera, time)
    focal = config.width / 2 / jnp.tan(scene.camera.half_angle)
    x, y = pixels[:, 0], pixels[:, 1]
    rays = jnp.stack([(x - config.width / 2) / focal, (y - config.height / 2) / focal, jnp.ones_like(x)])
    direction = rotation @ rays  # [3, P]: z is 1 in the camera, so the distance along the ray is the depth
    poses = part_poses(scene, config, time)
    near, _ = _intervals(scene, config, poses, origin[:, None], direction)
    enter = jnp.where(near > 0, near, jnp.inf)  # parts around the camera are invisible
    _, walls = slabs(origin[:, None], direction, scene.room_low[:, None], scene.room_high[:, None])
    depths = jnp.concatenate([walls.min(axis=0, keepdims=True), enter])  # [1 + K, P]
    part_ids = jnp.argmin(depths, axis=0)
    depth = depths.min(axis=0)
    point = origin[:, None] + depth[None] * direction
    normal, local, material = _hit(scene, config, poses, part_ids, walls, direction, point)
    colour = _albedo(textures, material, local, normal[1], depth / focal, direction, normal[0])
    light = scene.light[:, None] - point
    shaded = _shaded(scene, config, poses, point, light)
    towards = _dot(normal[0], light) / jnp.sqrt(_dot(light, light))
    diffuse = jnp.where(shaded, 0.0, jnp.maximum(towards, 0))
    brightness = scene.ambient + (1 - scene.ambient) * 1.3 * diffuse * material[11]
    return Surface(depth, part_ids.astype(jnp.int32), point, colour * brightness[None])


def _frame(scene: Scene, textures: Textures, config: SceneConfig, time: Array, step: float) -> SyntheticClip:
    H, W = config.height, config.width
    y, x = np.mgrid[0:H, 0:W].astype(np.float32)
    corners = np.stack([x.ravel(), y.ravel()], axis=-1)
    truth = cast(scene, textures, config, time, jnp.asarray(corners + 0.5))
    colour = truth.colour
    if config.samples > 1 or (config.exposures > 1 and config.shutter > 0):
        offsets = (np.stack(np.meshgrid(*2 * [np.arange(config.samples)]), -1).reshape(-1, 2) + 0.5) / config.samples
        opened = config.shutter * step * (np.arange(config.exposures) / config.exposures)

        def one(total, ray):
            offset, delay = ray
            return total + cast(scene, textures, config, time + delay, jnp.asarray(corners) + offset[None]).colour, None

        rays = np.repeat(offsets, len(opened), axis=0), np.tile(opened, len(offsets))
        rays = jax.tree.map(lambda values: jnp.asarray(values, jnp.float32), rays)
        colour = jax.lax.scan(one, jnp.zeros_like(colour), rays)[0] / len(rays[0])
    colour = jnp.clip(colour * jnp.exp(scene.exposure.at(time))[:, None], 0, 1)

    objects = np.concatenate([[0], np.asarray(config.objects) + 1])
    moving = jnp.concatenate([jnp.zeros(1, bool), scene.moving])[objects]
    poses, later = (_poses_with_room(scene, config, t) for t in (time, time + step))
    motion = compose(later, invert(poses))  # [1 + K, 3, 4]
    chosen = (_one_hot(truth.part_ids, len(objects)).T @ motion.reshape(len(objects), 12)).reshape(-1, 3, 4)
    flow = jnp.einsum("pij,jp->pi", chosen[..., :3] - jnp.eye(3)[None], truth.point) + chosen[..., 3]
    rotation, centre = camera_pose(scene.camera, time)
    return SyntheticClip(
        images=colour.T.reshape(H, W, 3),
        depth=truth.depth.reshape(H, W),
        object_ids=jnp.asarray(objects, jnp.int32)[truth.part_ids].reshape(H, W),
        part_ids=truth.part_ids.reshape(H, W),
        dynamic_mask=moving[truth.part_ids].reshape(H, W),
        scene_flow=flow.reshape(H, W, 3),
        camera_from_world=jnp.concatenate([rotation.T, -(rotation.T @ centre)[:, None]], axis=-1),
        intrinsics=intrinsics_of(scene, config),
        world_from_part=poses,
    )


def _intervals(scene: Scene, config: SceneConfig, poses, origin, direction):
    """Return where rays enter and leave every part, [K, P] each: at inf and -inf for missed and absent parts."""
    rotation, centre = poses
    intervals = []
    for kind, (interval, _) in SHAPES.items():  # in the order of the parts
        rows = np.flatnonzero(np.asarray(config.kinds) == kind)
        r, c = rotation[rows], centre[rows]
        o = jnp.einsum("kji,jp->kip", r, origin) - jnp.einsum("kji,kj->ki", r, c)[..., None]
        near, far = interval(o, jnp.einsum("kji,jp->kip", r, direction), scene.size[rows])
        hit = (near < far) & scene.present[rows][:, None]
        intervals.append((jnp.where(hit, near, jnp.inf), jnp.where(hit, far, -jnp.inf)))
    return tuple(jnp.concatenate(ends) for ends in zip(*intervals, strict=True))


def _shaded(scene: Scene, config: SceneConfig, poses, point, light) -> Bool[Array, " P"]:
    """Return whether a part stands between each point and the light."""
    near, far = _intervals(scene, config, poses, point, light)
    return ((jnp.maximum(near, 0) + _SELF) < jnp.minimum(far, 1)).any(axis=0)


def _hit(scene: Scene, config: SceneConfig, poses, part_ids, walls, direction, point):
    """Gather from the hit parts: normals in world and local axes, local position, material [12, P]."""
    rotation, centre = poses
    K = len(config.kinds)
    shape = np.asarray([list(SHAPES).index(kind) for kind in config.kinds])
    table = jnp.concatenate(
        [rotation.reshape(K, 9), centre, scene.size, jnp.asarray(np.eye(len(SHAPES))[shape], jnp.float32)], axis=-1
    )
    room = jnp.concatenate([jnp.eye(3).ravel(), jnp.zeros(3), jnp.ones(3), jnp.zeros(len(SHAPES))])
    table = jnp.concatenate([room[None], table])  # [1 + K, 18]
    row = table.T @ _one_hot(part_ids, K + 1)  # [18, P]
    r, c, size, kind = row[:9].reshape(3, 3, -1), row[9:12], row[12:15], row[15:]
    local = jnp.stack([_dot(r[:, i], point - c) for i in range(3)])  # R^T (x - c)
    normals = jnp.stack([normal(local, size) for _, normal in SHAPES.values()])  # [shapes, 3, P]
    normal = _dot(normals, kind[:, None])
    in_room = part_ids == 0
    axis = jnp.argmin(walls, axis=0)
    is_wall = jnp.arange(3)[:, None] == axis[None]
    normal = jnp.where(in_room[None], jnp.where(is_wall, -jnp.sign(direction), 0), normal)
    upper = jnp.take_along_axis(direction, axis[None], axis=0)[0] > 0
    surface = jnp.where(in_room, K + 2 * axis + upper, part_ids - 1)
    material = scene.material.T @ _one_hot(surface, K + ROOM_FACES)
    return (jnp.stack([_dot(r[i], normal) for i in range(3)]), normal), local, material


def _albedo(textures: Textures, material, local, normal, width, direction, world_normal) -> Float[Array, "3 P"]:
    """Return the texture, projected along the main axis of the local normal, in the material's scale and colours."""
    tile, repeat, cos, sin, *offset = material[:6]
    x, y, z = jnp.abs(normal)
    flat = (y >= x) & (y >= z)
    u = jnp.where(~flat & (x > z), local[2], local[0])
    v = jnp.where(flat, local[2], local[1])
    uv = repeat[None] * jnp.stack([cos * u - sin * v, sin * u + cos * v]) + jnp.stack(offset)
    slant = jnp.abs(_dot(direction, world_normal)) / jnp.sqrt(_dot(direction, direction))
    footprint = repeat * width / jnp.maximum(slant, 0.3)
    texture = sample(textures, tile.astype(jnp.int32), uv, footprint)
    gain, saturation, contrast = material[6:9], material[9], material[10]
    grey = texture.mean(axis=0, keepdims=True)
    colour = grey + saturation[None] * (texture - grey)
    return jnp.clip(gain * (0.5 + contrast[None] * (colour - 0.5)), 0.02, 1)


def _dot(a: Float[Array, "3 ..."], b: Float[Array, "3 ..."]) -> Float[Array, ...]:
    """Sum over the leading axis, written out: as a reduction, XLA's CPU compiler (jax 0.10) fuses it wrongly."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _one_hot(index: Int[Array, " P"], count: int) -> Float[Array, "N P"]:
    return (index[None] == jnp.arange(count, dtype=index.dtype)[:, None]).astype(jnp.float32)


def _poses_with_room(scene: Scene, config: SceneConfig, time: Array) -> Float[Array, "N 3 4"]:
    rotation, centre = part_poses(scene, config, time)
    poses = jnp.concatenate([rotation, centre[..., None]], axis=-1)
    return jnp.concatenate([jnp.eye(3, 4)[None], poses])
