"""Textured triangles in metres, z up: flat pieces, boxes, relief, boulders, and their concatenation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int

from vggtjax.training.world.assets import Shape


class Surface(NamedTuple):
    """How triangles look: the number of a tile, its repetitions a metre, gain of the three channels."""

    tile: int
    repeat: float = 1.0
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turn: float = 0.0  # of the texture, radians


class Mesh(NamedTuple):
    """Triangles with texture coordinates at their corners, in units of a tile."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "F 3 2"]
    tile: Int[np.ndarray, " F"]
    gain: Float[np.ndarray, "F 3"]

    def moved(self, rotation: Float[np.ndarray, "3 3"], offset: Float[np.ndarray, " 3"]) -> Mesh:
        """Return the mesh turned, then moved."""
        return self._replace(vertices=(self.vertices @ rotation.T + offset).astype(np.float32))


def join(meshes: list[Mesh]) -> Mesh:
    """Return one mesh of all triangles."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    columns = zip(*((mesh.uv, mesh.tile, mesh.gain) for mesh in meshes), strict=True)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), *(np.concatenate(c) for c in columns)
    )


def covered(vertices: np.ndarray, faces: np.ndarray, surface: Surface) -> Mesh:
    """Return triangles with a texture projected along the main axis of each one's normal."""
    vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    corners = vertices[faces]  # [F, 3, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(axis=1)
    u = np.where(axis == 0, 1, 0)  # x, unless the normal is along x
    v = np.where(axis == 2, 1, 2)  # z, unless the normal is along z
    row = np.arange(len(faces))[:, None]
    uv = np.stack([corners[row, np.arange(3), u[:, None]], -corners[row, np.arange(3), v[:, None]]], axis=-1)
    cos, sin = np.cos(surface.turn), np.sin(surface.turn)
    uv = surface.repeat * uv @ np.asarray([[cos, -sin], [sin, cos]], np.float32)
    return _mesh(vertices, faces, uv, surface)


def of_shape(shape: Shape, gain: tuple[float, float, float] = (1.0, 1.0, 1.0), pose: int = 0) -> Mesh:
    """Return an object's mesh in one of its poses."""
    return _mesh(shape.vertices[pose], shape.faces, shape.uv, Surface(shape.tile, gain=gain))


def picture(origin, along, up, surface: Surface) -> Mesh:
    """Return a parallelogram that shows its tile once: `origin` is the lower left corner, metres."""
    origin, along, up = (np.asarray(x, np.float32) for x in (origin, along, up))
    vertices = np.stack([origin, origin + along, origin + along + up, origin + up])
    corners = np.asarray([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32) * 0.999 + 0.0005
    faces = np.asarray([[0, 1, 2], [0, 2, 3]], np.int32)
    return _mesh(vertices, faces, corners[faces], surface)


def cutout(generator: np.random.Generator, width: float, height: float, surface: Surface) -> Mesh:
    """Return an upright picture in the x-z plane with a random smooth outline, standing on z = 0."""
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    radius = np.ones(32)
    for k in (2, 3, 5):
        radius += generator.uniform(-0.5, 0.5) / k * np.cos(k * angle + generator.uniform(0, 2 * np.pi))
    outline = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * radius[:, None]
    outline = (outline - outline.min(axis=0)) / np.ptp(outline, axis=0)
    points = np.concatenate([outline.mean(axis=0, keepdims=True), outline]).astype(np.float32)
    ring = np.arange(32)
    faces = np.stack([np.zeros(32, int), 1 + ring, 1 + (ring + 1) % 32], axis=-1).astype(np.int32)
    vertices = np.stack([(points[:, 0] - 0.5) * width, 0 * points[:, 0], points[:, 1] * height], axis=-1)
    uv = (points * np.asarray([1, -1], np.float32) + np.asarray([0, 1], np.float32)) * 0.99 + 0.005
    return _mesh(vertices, faces, uv[faces], surface)


def box(size, surface: Surface) -> Mesh:
    """Return a box of a size along x, y, z that stands on z = 0, centred in x and y."""
    made = trimesh.creation.box(extents=size)
    return covered(np.add(made.vertices, [0, 0, size[2] / 2]), made.faces, surface)


def pillar(radius: float, height: float, surface: Surface) -> Mesh:
    """Return an upright cylinder that stands on z = 0."""
    made = trimesh.creation.cylinder(radius=radius, height=height, sections=12)
    return covered(np.add(made.vertices, [0, 0, height / 2]), made.faces, surface)


def boulder(generator: np.random.Generator, size, roughness: float, surface: Surface) -> Mesh:
    """Return a lumpy ellipsoid of a size along x, y, z, centred at 0."""
    made = trimesh.creation.icosphere(subdivisions=3)
    points = np.asarray(made.vertices)
    lumps = np.zeros(len(points))
    for k in (1, 2, 3, 5, 8):
        along, phase = k * points @ generator.standard_normal(3), generator.uniform(0, 2 * np.pi)
        lumps += generator.uniform(0, roughness / k) * np.sin(along + phase)
    return covered(points * (1 + lumps[:, None]) * np.asarray(size) / 2, made.faces, surface)


def relief(xs: np.ndarray, ys: np.ndarray, heights: Float[np.ndarray, "Y X"], surface: Surface) -> Mesh:
    """Return the ground over a grid of x and y."""
    x, y = np.meshgrid(xs, ys)
    vertices = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
    at = np.arange(x.size).reshape(x.shape)
    corners = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    faces = np.concatenate([np.stack(corners[:3], -1), np.stack([corners[0], corners[2], corners[3]], -1)])
    mesh = covered(vertices, faces, surface)
    flat = vertices[faces][..., :2] * surface.repeat  # from above also where it is steep
    return mesh._replace(uv=flat.astype(np.float32))


def _mesh(vertices, faces, uv, surface: Surface) -> Mesh:
    count = len(faces)
    gain = np.broadcast_to(np.asarray(surface.gain, np.float32), (count, 3))
    tile = np.full(count, surface.tile, np.int32)
    return Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int32), np.asarray(uv, np.float32), tile, gain)
