"""A result as one 3-D scene for viewers (GLB): the static cloud, each frame's moving points, and the cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.exchange.gltf import export_glb
from trimesh.visual import ColorVisuals

from vggtjax.cameras import FRUSTUM_EDGES, frustum_corners
from vggtjax.results.colors import LINEAR, color_ramp
from vggtjax.results.gltf_animation import TO_GLTF
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result
from vggtjax.results.shown import POINT_LIMIT, shown_points
from vggtjax.storage.arrays import is_mapped

_FLOAT = 5126  # glTF's name
_UNLIT = {
    "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}
_MAPPED_LIMIT = 400_000  # of a mapped result: a point takes up to 100 bytes of memory while the file is made
_STATIC_SHARE = 0.8  # of these points
_CAMERA_SIZE = 0.06  # of the median distance from the middle of the cameras to the points
_MOST_DISTANCES = 200_000  # of a cloud, of which the median is taken
_BAR_SIZE = 0.015  # of a camera: half the thickness of its edges

# A bar between two squares of corners 0-3 and 4-7.
_BAR_FACES = np.array([[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])


def result_scene(result: Result, confidence_percentile: float) -> trimesh.Scene:
    """Return the scene of a result without its least confident points, of at most `POINT_LIMIT` points."""
    limit = _MAPPED_LIMIT if is_mapped(result.depth) else POINT_LIMIT
    most_static = round(_STATIC_SHARE * limit)
    static, moving = shown_points(
        result,
        static_percentile=confidence_percentile,
        dynamic_percentile=confidence_percentile,
        edges=None,
        most_static=most_static,
        most_moving=(limit - most_static) // len(result.depth),
    )
    return build_scene(result, static.cloud(result), [points.cloud(result) for points in moving])


def build_scene(result: Result, static: PointCloud, moving: Sequence[PointCloud]) -> trimesh.Scene:
    """Return the scene, with y up.

    Nodes: one for each cloud with points, `static` and a frame's `dynamic_000000`, and `cameras`: a frustum per frame,
    open in the viewing direction, with a filled triangle on its upper edge, coloured from the first frame to the last,
    and the path between them. Colours are sRGB; `glb_bytes` writes them as glTF wants them.
    """
    scene = trimesh.Scene()
    clouds = {"static": static} | {f"dynamic_{frame:06d}": cloud for frame, cloud in enumerate(moving)}
    shown = {name: cloud for name, cloud in clouds.items() if len(cloud)}
    for name, cloud in shown.items():
        scene.add_geometry(trimesh.PointCloud(cloud.points * TO_GLTF, cloud.colors), node_name=name, geom_name=name)
    mesh = _camera_mesh(result, _camera_size(result, shown.values()))
    scene.add_geometry(mesh, node_name="cameras", geom_name="cameras")
    return scene


def glb_bytes(scene: trimesh.Scene, edit: Callable[[dict[str, bytes], dict[str, Any]], None] | None = None) -> bytes:
    """Return the scene as a GLB file; `edit` may change its buffers and its tree, as a `buffer_postprocessor`."""

    def finish(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
        _colors_of_gltf(buffers, tree)
        if edit is not None:
            edit(buffers, tree)

    return export_glb(scene, buffer_postprocessor=finish)


def _camera_size(result: Result, clouds: Iterable[PointCloud]) -> float:
    middle = result.camera_centres.mean(axis=0, dtype=np.float64)
    points = [cloud.points[:: -(-len(cloud) // _MOST_DISTANCES)] for cloud in clouds]
    distances = [np.linalg.norm(some - middle, axis=-1) for some in points]
    return _CAMERA_SIZE * (float(np.median(np.concatenate(distances))) if distances else 1.0)


def _camera_mesh(result: Result, size: float) -> trimesh.Trimesh:
    """Return the cameras, each as long as `size` from its centre to its corners, and the path between them."""
    frames, height, width = result.depth.shape
    corners = frustum_corners(result.intrinsics, result.camera_from_world, height, width, size)  # [S, 5, 3]
    corners = corners.astype(np.float64)
    colors = color_ramp("plasma")[np.linspace(0, 230, frames).round().astype(int)]

    edges = corners[:, FRUSTUM_EDGES].reshape(-1, 2, 3)
    path = np.stack([corners[:-1, 0], corners[1:, 0]], axis=1)
    bars, bar_faces, bar_edges = _bars(np.concatenate([edges, path]), size * _BAR_SIZE)
    edge_frames = np.concatenate([np.repeat(np.arange(frames), len(FRUSTUM_EDGES)), np.arange(frames - 1)])

    left, right, low = corners[:, 1], corners[:, 2], corners[:, 4]
    roofs = np.stack([left, right, (left + right) / 2 + 0.4 * (left - low)], axis=1).reshape(-1, 3)
    roof_faces = np.arange(3 * frames).reshape(-1, 3)
    roof_faces = np.concatenate([roof_faces, roof_faces[:, ::-1]])  # seen from both sides
    vertex_frames = np.concatenate([np.repeat(edge_frames[bar_edges], 8), np.repeat(np.arange(frames), 3)])
    vertices, faces = np.concatenate([bars, roofs]), np.concatenate([bar_faces, roof_faces + len(bars)])
    mesh = trimesh.Trimesh(vertices * TO_GLTF, faces, process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=colors[vertex_frames])
    return mesh


def _bars(
    edges: Float[np.ndarray, "E 2 3"], half_thickness: float
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"], Int[np.ndarray, " B"]]:
    """Return vertices (eight per bar) and faces of square bars along the edges longer than 0, and these edges."""
    along = edges[:, 1] - edges[:, 0]
    lengths = np.linalg.norm(along, axis=-1)
    (used,) = np.nonzero(lengths > 0)
    along = along[used] / lengths[used, None]
    across = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=-1)])  # with the axis least along the edge
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    up = np.cross(along, across)
    square = half_thickness * np.stack([across + up, up - across, -across - up, across - up], axis=1)  # [B, 4, 3]
    vertices = (edges[used][:, :, None] + square[:, None]).reshape(-1, 3)
    faces = (8 * np.arange(len(used))[:, None, None] + _BAR_FACES).reshape(-1, 3)
    return vertices, faces, used


def _colors_of_gltf(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
    """Make the 8-bit sRGB colours of trimesh's vertices linear, and show them as they are, without lights.

    glTF's vertex colours are linear, and viewers encode them for the screen: numbers of sRGB would look pale there. In
    8 bits the dark tones of linear colours fall together (the first 64 levels of sRGB become 14, which looks dark and
    banded), and trimesh reads 16 bits wrongly, so they are float32. Without KHR_materials_unlit viewers light the
    frusta, which are black where there is no light.
    """
    names, parts = list(buffers), [part for mesh in tree["meshes"] for part in mesh["primitives"]]
    for accessor in {part["attributes"]["COLOR_0"] for part in parts if "COLOR_0" in part["attributes"]}:
        entry = list(tree["accessors"].values())[accessor]
        name = names[entry["bufferView"]]
        colors = np.frombuffer(buffers[name], np.uint8).reshape(-1, 4)[: entry["count"], :3]
        buffers[name] = LINEAR[colors].tobytes()
        entry |= {"componentType": _FLOAT, "type": "VEC3"}
        for key in ("normalized", "min", "max"):
            entry.pop(key, None)
    tree["materials"] = [_UNLIT]
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), *_UNLIT["extensions"]})
    for part in parts:
        part["material"] = 0
