"""A coloured mesh of the static part of a result, by marching cubes: GLB with y up, or PLY in the result's axes."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes
from trimesh.exchange.ply import export_ply
from trimesh.visual import ColorVisuals

from vggtjax.errors import InputError
from vggtjax.progress import Progress
from vggtjax.results.exports.table import Exporting
from vggtjax.results.exports.volume import StaticSurfaces
from vggtjax.results.glb import glb_bytes
from vggtjax.results.gltf_animation import TO_GLTF, add_camera
from vggtjax.results.result import Result

_LEAST_FACES = 100  # of a connected part: smaller ones are noise


def write_mesh(path: Path, result: Result, exporting: Exporting, progress: Progress | None = None) -> None:
    """Write `static_mesh` by the suffix of the path: .glb has the clip's camera too, .ply the mesh alone."""
    mesh = static_mesh(result, exporting, progress)
    if path.suffix.lower() == ".ply":
        path.write_bytes(export_ply(mesh))
        return
    mesh.vertices = mesh.vertices * TO_GLTF
    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="static", geom_name="static")
    path.write_bytes(glb_bytes(scene, partial(add_camera, result)))


def static_mesh(
    result: Result, exporting: Exporting = Exporting(), progress: Progress | None = None
) -> trimesh.Trimesh:
    """Return the mesh of the surfaces that stand still, in the world's axes, with colours; it has holes where none saw.

    Args:
        result: of a clip.
        exporting: percent of the static pixels, the least confident, to leave out, and the edge of a voxel: by default
            as wide as a pixel on the surfaces, or half of the median difference between frames where that is more.
        progress: called with the number of frames read, and of all; each is read several times.

    Raises InputError where nothing static is seen, or where voxels of that size are more than 2 ** 26, or too large.
    """
    surfaces = StaticSurfaces(result, exporting.confidence_percentile, progress)
    grid = surfaces.grid(exporting.voxel_size)
    distance, known = surfaces.distances(grid)
    try:
        vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=_whole_cubes(known), gradient_direction="descent")
    except (RuntimeError, ValueError) as error:  # no change of sign, in whole cubes or at all
        raise InputError(
            f"voxels of {grid.voxel:.3g} find no surface: they are too large (--voxel-size), or the cameras are far "
            "apart for the depth that they see"
        ) from error
    faces = faces[_large_parts(faces.astype(np.int64), len(vertices))]
    mesh = trimesh.Trimesh(grid.low + grid.voxel * vertices.astype(np.float64), faces, process=False)
    mesh.remove_unreferenced_vertices()
    colors = surfaces.colors(mesh.vertices.astype(np.float32), grid.reach)
    mesh.visual = ColorVisuals(mesh, vertex_colors=colors.round().astype(np.uint8))
    return mesh


def _whole_cubes(known: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Return the cubes with eight known corners, each at its highest corner, where marching cubes looks for it."""
    whole = np.zeros_like(known)
    corners = known[:-1] & known[1:]
    corners = corners[:, :-1] & corners[:, 1:]
    whole[1:, 1:, 1:] = corners[:, :, :-1] & corners[:, :, 1:]
    return whole


def _large_parts(faces: Int64[np.ndarray, "F 3"], vertices: int) -> Bool[np.ndarray, " F"]:
    """Return the faces of connected parts of at least `_LEAST_FACES` faces, or of the largest one."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(vertices, vertices))
    parts = connected_components(graph, directed=False)[1][faces[:, 0]]
    sizes = np.bincount(parts)
    return sizes[parts] >= min(_LEAST_FACES, sizes.max())
