"""Ray casting by Embree: the first hits of rays in a world at a time, their colours, and where their points move."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vggtjax.errors import check_extra
from vggtjax.training.world.assets import Tiles, sample_panorama, sample_tiles
from vggtjax.training.world.meshes import Mesh, join
from vggtjax.training.world.motion import Actor

FARTHEST = 120.0  # metres along z; what is farther is sky
_OFF = 2e-3  # metres from a surface to the start of its ray to the light


_NOTHING = Mesh(
    np.zeros((0, 3), np.float32),
    np.zeros((0, 3), np.int32),
    np.zeros((0, 3, 2), np.float32),
    np.zeros(0, np.int32),
    np.zeros((0, 3), np.float32),
)


class Light(NamedTuple):
    """The sun, by a direction, or a lamp, by a place; the share of light that comes from everywhere; colours."""

    place: Float[np.ndarray, " 3"]  # of a lamp, metres; of the sun a unit vector
    is_lamp: bool
    ambient: float
    colour: Float[np.ndarray, " 3"]


class Still(NamedTuple):
    """What stands still, made ready for casting."""

    mesh: Mesh
    scene: Any  # Embree's
    density: Float[np.ndarray, " F"]  # tiles a metre of every triangle


class World(NamedTuple):
    """What stands still, what moves, and the light."""

    still: Still
    actors: tuple[Actor, ...]
    light: Light
    panorama: UInt8[np.ndarray, "H W 3"]  # the sky
    sky_turn: float  # radians


class Hits(NamedTuple):
    """The first hits of rays; where there is none, `actor` is -1, `face` is 0 and the distance is inf."""

    distance: Float[np.ndarray, " P"]  # in units of the ray's direction
    actor: Int[np.ndarray, " P"]  # 0 for what stands still, from 1 for actors
    face: Int[np.ndarray, " P"]  # of the mesh that stands still, or of all actors' meshes together
    corners: Float[np.ndarray, "P 3"]  # barycentric


def prepare(mesh: Mesh) -> Still:
    """Return a mesh that stands still, made ready for casting."""
    return Still(mesh, _embree(mesh.vertices, mesh.faces), _density(mesh))


class Moment:
    """A world at a time in seconds."""

    def __init__(self, stage: Stage, time: float) -> None:
        self._stage = stage
        self.positions = [actor.vertices(time) for actor in stage.world.actors]
        self._vertices = np.concatenate(self.positions) if self.positions else np.zeros((0, 3), np.float32)
        self._actors = None if not self.positions else _embree(self._vertices, stage.moving.faces)

    def cast(self, origin: Float[np.ndarray, "P 3"], direction: Float[np.ndarray, "P 3"]) -> Hits:
        """Return the first hits of rays."""
        stage = self._stage
        found = _first(stage.world.still.scene, origin, direction)
        if self._actors is None:
            return Hits(found[0], np.where(np.isfinite(found[0]), 0, -1), *found[1:])
        other = _first(self._actors, origin, direction)
        nearer = other[0] < found[0]
        distance, face, corners = (
            np.where(nearer.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(found, other, strict=True)
        )
        actor = np.where(nearer, stage.actor_of_face[np.where(nearer, face, 0)], 0)
        return Hits(distance, np.where(np.isfinite(distance), actor, -1), face, corners)

    def colours(
        self, hits: Hits, origin: Float[np.ndarray, "P 3"], direction: Float[np.ndarray, "P 3"], pixel: float
    ) -> Float[np.ndarray, "P 3"]:
        """Return what rays see, in [0, 1]; `pixel` is the size of a pixel at distance 1."""
        stage, world = self._stage, self._stage.world
        colour = np.empty((len(hits.face), 3), np.float32)
        sky = hits.actor < 0
        if sky.any():
            c, s = np.cos(world.sky_turn), np.sin(world.sky_turn)
            x, y, z = direction[sky].T
            colour[sky] = sample_panorama(world.panorama, np.stack([c * x - s * y, s * x + c * y, z], axis=-1))
        for moves in (False, True):
            rays = np.flatnonzero((hits.actor > 0) if moves else (hits.actor == 0))
            if not rays.size:
                continue
            mesh, density = (stage.moving, stage.moving_density) if moves else (world.still.mesh, world.still.density)
            vertices = self._vertices if moves else mesh.vertices
            face, corners = hits.face[rays], hits.corners[rays]
            triangle = vertices[mesh.faces[face]]
            normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
            toward = np.einsum("pc,pc->p", normal, direction[rays])
            normal = np.where(toward[:, None] > 0, -normal, normal)  # both sides are seen
            length = np.linalg.norm(direction[rays], axis=1)
            footprint = density[face] * pixel * hits.distance[rays] / np.maximum(np.abs(toward) / length, 0.25)
            uv = np.einsum("pk,pkc->pc", corners, mesh.uv[face])
            albedo = sample_tiles(stage.tiles, mesh.tile[face], uv, footprint) * mesh.gain[face]
            point = origin[rays] + hits.distance[rays, None] * direction[rays]
            colour[rays] = albedo * self._brightness(point, normal)
        return np.clip(colour, 0, 1)

    def _brightness(
        self, point: Float[np.ndarray, "P 3"], normal: Float[np.ndarray, "P 3"]
    ) -> Float[np.ndarray, "P 3"]:
        light = self._stage.world.light
        to_light = light.place - point if light.is_lamp else np.broadcast_to(light.place, point.shape)
        distance = np.linalg.norm(to_light, axis=1, keepdims=True)
        facing = np.einsum("pc,pc->p", normal, to_light / distance)
        start, reach = point + _OFF * normal, to_light if light.is_lamp else 300.0 * to_light
        hidden = facing <= 0
        lit = np.flatnonzero(~hidden)
        for scene in (self._stage.world.still.scene, self._actors):
            if scene is not None and lit.size:
                hidden[lit] |= _hides(scene, start[lit], reach[lit])
        direct = np.where(hidden, 0, facing)
        if light.is_lamp:  # a lamp fades with the distance
            direct = direct * np.minimum(1.5, 6.0 / (1 + distance[:, 0] ** 2 / 4))
        above = 0.75 + 0.25 * normal[:, 2]
        brightness = light.ambient * above[:, None] + (1 - light.ambient) * 1.25 * direct[:, None] * light.colour
        return brightness.astype(np.float32)


class Stage:
    """A world and its tiles; the meshes of all actors as one, whose faces are those of `Hits`."""

    def __init__(self, world: World, tiles: Tiles) -> None:
        self.world, self.tiles = world, tiles
        self.moving = join([actor.mesh for actor in world.actors]) if world.actors else _NOTHING
        self.moving_density = _density(self.moving)
        counts = [len(actor.mesh.faces) for actor in world.actors]
        self.actor_of_face = np.repeat(np.arange(1, len(counts) + 1), counts)
        self.first_face = np.cumsum([0, *counts])

    def followed(self, point, hits: Hits, moments: list[Moment]) -> Float[np.ndarray, "N P 3"]:
        """Return where the points [P, 3] of `hits` are at other moments."""
        places = np.broadcast_to(np.asarray(point, np.float32), (len(moments), *point.shape)).copy()
        for number, actor in enumerate(self.world.actors, start=1):
            rays = np.flatnonzero(hits.actor == number)
            if rays.size:
                corners = actor.mesh.faces[hits.face[rays] - self.first_face[number - 1]]
                for index, moment in enumerate(moments):
                    triangle = moment.positions[number - 1][corners]
                    places[index, rays] = np.einsum("pk,pkc->pc", hits.corners[rays], triangle)
        return places


def check_embree() -> None:
    """Raise MissingExtraError unless Embree is installed; call it before long work."""
    check_extra("drawing scenes from a folder of assets", "train", "embreex")


def _embree(vertices: np.ndarray, faces: np.ndarray) -> Any:
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene: Any = rtcore_scene.EmbreeScene()  # pyright: ignore
    TriangleMesh(scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))
    return scene


def _first(scene, origin, direction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance (inf without a hit), face and barycentric corners of the first hits."""
    found = scene.run(
        np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32), output=True
    )
    hit = found["primID"] >= 0
    u, v = found["u"], found["v"]
    corners = np.stack([1 - u - v, u, v], axis=-1)
    return np.where(hit, found["tfar"], np.inf), np.where(hit, found["primID"], 0), np.where(hit[:, None], corners, 0)


def _hides(scene, origin, direction) -> Bool[np.ndarray, " P"]:
    """Return which rays hit something before the end of their direction."""
    origin, direction = (np.ascontiguousarray(x, np.float32) for x in (origin, direction))
    found = scene.run(origin, direction, dists=np.ones(len(origin), np.float32), query="OCCLUDED")
    return np.asarray(found) >= 0


def _density(mesh: Mesh) -> Float[np.ndarray, " F"]:
    """Return tiles a metre of every triangle."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q, r = np.moveaxis(mesh.uv, 1, 0)
    shown = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    return np.sqrt(shown / np.maximum(area, 1e-12)).astype(np.float32)
