"""A result as one 3-D scene for viewers (GLB): the static cloud, each frame's moving points, and the cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import trimesh
from cmap import Colormap
from jaxtyping import Float, Int
from trimesh.exchange.gltf import export_glb
from trimesh.visual import ColorVisuals

from vggtjax.cameras import frustum_corners
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result

_LEVELS = np.arange(256) / 255  # of sRGB
_LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
_FLOAT = 5126  # glTF's name
_UNLIT = {
    "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}
POINT_LIMIT = 1_000_000  # viewers in a browser still turn so many points smoothly
_TO_GLTF = np.array([1, -1, -1], np.float32)  # half a turn about x: y down and z forward become y up and z backward
_CAMERA_SIZE = 0.06  # of the median distance from the middle of the cameras to the points
_BAR_SIZE = 0.015  # of a camera: half the thickness of its edges

# Corners of `frustum_corners`: 0 the centre, then 1 top left, 2 top right, 3 bottom right, 4 bottom left.
_FRUSTUM_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
# A bar between two squares of corners 0-3 and 4-7.
_BAR_FACES = np.array([[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])


def build_scene(
    result: Result, static: PointCloud, dynamic: Sequence[PointCloud], *, point_limit: int = POINT_LIMIT
) -> trimesh.Scene:
    """Return the scene, with y up.

    Nodes: `static`, `dynamic_000000` for each frame with moving points, and `cameras`: a frustum per frame, open in the
    viewing direction, with a filled triangle on its upper edge, coloured from the first frame to the last, and the path
    between them. Of more than `point_limit` points every cloud keeps the same share, drawn with a fixed seed. Colours
    are sRGB; `glb_bytes` writes them as glTF wants them.
    """
    clouds = {"static": static} | {f"dynamic_{frame:06d}": cloud for frame, cloud in enumerate(dynamic)}
    share = min(1.0, point_limit / max(1, sum(map(len, clouds.values()))))
    random = np.random.default_rng(0)
    middle = result.camera_centres.mean(axis=0, dtype=np.float64)
    distances = []
    scene = trimesh.Scene()
    for name, cloud in clouds.items():
        chosen = random.choice(len(cloud), int(share * len(cloud)), replace=False, shuffle=False)
        if chosen.size:
            points, colors = cloud.points[chosen], cloud.colors[chosen]
            scene.add_geometry(trimesh.PointCloud(points * _TO_GLTF, colors), node_name=name, geom_name=name)
            distances.append(np.linalg.norm(points - middle, axis=-1))
    size = _CAMERA_SIZE * (float(np.median(np.concatenate(distances))) if distances else 1.0)
    scene.add_geometry(_cameras(result, size), node_name="cameras", geom_name="cameras")
    return scene


def glb_bytes(scene: trimesh.Scene, edit: Callable[[dict[str, bytes], dict[str, Any]], None] | None = None) -> bytes:
    """Return the scene as a GLB file; `edit` may change its buffers and its tree, as a `buffer_postprocessor`."""

    def finish(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
        _colors_of_gltf(buffers, tree)
        if edit is not None:
            edit(buffers, tree)

    return export_glb(scene, buffer_postprocessor=finish)


def _cameras(result: Result, size: float) -> trimesh.Trimesh:
    frames, height, width = result.depth.shape
    corners = frustum_corners(result.intrinsics, result.camera_from_world, height, width, size)  # [S, 5, 3]
    corners = corners.astype(np.float64)
    colors = (Colormap("plasma")(np.linspace(0, 0.9, frames))[:, :3] * 255).round().astype(np.uint8)

    edges = corners[:, _FRUSTUM_EDGES].reshape(-1, 2, 3)
    path = np.stack([corners[:-1, 0], corners[1:, 0]], axis=1)
    bars, bar_faces, bar_edges = _bars(np.concatenate([edges, path]), size * _BAR_SIZE)
    edge_frames = np.concatenate([np.repeat(np.arange(frames), len(_FRUSTUM_EDGES)), np.arange(frames - 1)])

    left, right, low = corners[:, 1], corners[:, 2], corners[:, 4]
    roofs = np.stack([left, right, (left + right) / 2 + 0.4 * (left - low)], axis=1).reshape(-1, 3)
    roof_faces = np.arange(3 * frames).reshape(-1, 3)
    roof_faces = np.concatenate([roof_faces, roof_faces[:, ::-1]])  # seen from both sides

    mesh = trimesh.Trimesh(
        np.concatenate([bars, roofs]) * _TO_GLTF, np.concatenate([bar_faces, roof_faces + len(bars)]), process=False
    )
    vertex_frames = np.concatenate([np.repeat(edge_frames[bar_edges], 8), np.repeat(np.arange(frames), 3)])
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
    names = list(buffers)
    for accessor in {number for mesh in tree["meshes"] for number in _colors_of(mesh)}:
        entry = list(tree["accessors"].values())[accessor]
        name = names[entry["bufferView"]]
        colors = np.frombuffer(buffers[name], np.uint8).reshape(-1, 4)[: entry["count"], :3]
        buffers[name] = _LINEAR[colors].tobytes()
        entry |= {"componentType": _FLOAT, "type": "VEC3"}
        for key in ("normalized", "min", "max"):
            entry.pop(key, None)
    tree["materials"] = [_UNLIT]
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), *_UNLIT["extensions"]})
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def _colors_of(mesh: dict[str, Any]) -> Iterator[int]:
    """Yield the numbers of the accessors of a mesh's colours."""
    return (part["attributes"]["COLOR_0"] for part in mesh["primitives"] if "COLOR_0" in part["attributes"])
