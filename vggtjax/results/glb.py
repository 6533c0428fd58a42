"""A result as one 3-D scene for viewers (GLB): the static cloud, each frame's moving points, and the cameras."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from cmap import Colormap
from jaxtyping import Bool, Float, Int, UInt8

from vggtjax.cameras import frustum_corners
from vggtjax.results.frame import LeastConfidence, ResultFrame, frame_of
from vggtjax.results.point_cloud import PointCloud, frame_cloud
from vggtjax.results.result import Result
from vggtjax.storage.arrays import zeros_beside
from vggtjax.storage.glb_file import POINTS, TRIANGLES, GlbFile

_LEVELS = np.arange(256) / 255  # of sRGB
_LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
POINT_LIMIT = 1_000_000  # viewers in a browser still turn so many points smoothly
_STATIC = "static"
_TO_GLTF = np.array([1, -1, -1], np.float32)  # half a turn about x: y down and z forward become y up and z backward
_CAMERA_SIZE = 0.06  # of the median distance from the middle of the cameras to the points
_MOST_DISTANCES = 200_000  # of a cloud, of which the median is taken
_BAR_SIZE = 0.015  # of a camera: half the thickness of its edges

# Corners of `frustum_corners`: 0 the centre, then 1 top left, 2 top right, 3 bottom right, 4 bottom left.
_FRUSTUM_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
# A bar between two squares of corners 0-3 and 4-7.
_BAR_FACES = np.array([[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])


class CameraMesh(NamedTuple):
    """The cameras of a clip and the path between them, in the world, y down."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    colors: UInt8[np.ndarray, "V 3"]  # sRGB


def clip_clouds(result: Result, least: LeastConfidence, *, point_limit: int = POINT_LIMIT) -> dict[str, PointCloud]:
    """Return the points of a scene by the names of their nodes; those of a mapped result are mapped.

    `static` are those of all frames, `dynamic_000000` the moving ones of a frame. Of more than `point_limit` points
    every cloud keeps the same share, drawn with a fixed seed.
    """
    frames = range(len(result.depth))
    counts = np.array([[part.sum() for part in _static_and_moving(frame_of(result, n), least)] for n in frames])
    choice = _EvenChoice(int(counts.sum()), point_limit)
    static, moving = (_Store(result, choice, int(count)) for count in counts.sum(axis=0))
    clouds: dict[str, PointCloud] = {}
    for number in frames:
        frame = frame_of(result, number)
        of_static, of_moving = (frame_cloud(frame, pixels) for pixels in _static_and_moving(frame, least))
        static.add(of_static)
        clouds[_moving_name(number)] = moving.add(of_moving)
    return {_STATIC: static.all(), **clouds}


def limited_clouds(
    static: PointCloud, moving: Sequence[PointCloud], *, point_limit: int = POINT_LIMIT
) -> dict[str, PointCloud]:
    """Return the static cloud of a clip and the moving ones of its frames, limited and named as by `clip_clouds`."""
    choice = _EvenChoice(len(static) + sum(map(len, moving)), point_limit)
    clouds = {_STATIC: static} | {_moving_name(frame): cloud for frame, cloud in enumerate(moving)}
    return {name: choice(cloud) for name, cloud in clouds.items()}


def build_scene(result: Result, clouds: Mapping[str, PointCloud]) -> GlbFile:
    """Return the scene, with y up.

    Nodes: one for each cloud with points, and `cameras`: a frustum per frame, open in the viewing direction, with a
    filled triangle on its upper edge, coloured from the first frame to the last, and the path between them. Colours of
    clouds are sRGB; glTF's are linear, which takes float32: in 8 bits the dark tones of linear colours fall together
    (the first 64 levels of sRGB become 14, which looks dark and banded).
    """
    shown = {name: cloud for name, cloud in clouds.items() if len(cloud)}
    glb = GlbFile()
    for name, cloud in shown.items():
        glb.node(name, POINTS, _attributes(glb, cloud.points, cloud.colors))
    cameras = camera_mesh(result, _camera_size(result, shown.values()))
    faces = glb.array(cameras.faces.reshape(-1).astype(np.uint32))
    glb.node("cameras", TRIANGLES, _attributes(glb, cameras.vertices, cameras.colors), faces)
    return glb


def _attributes(glb: GlbFile, points: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"]) -> dict[str, int]:
    return {
        "POSITION": glb.array(points, lambda piece: (piece * _TO_GLTF).astype(np.float32), bounds=True),
        "COLOR_0": glb.array(colors, lambda piece: _LINEAR[piece]),
    }


def _moving_name(frame: int) -> str:
    return f"dynamic_{frame:06d}"


def _static_and_moving(
    frame: ResultFrame, least: LeastConfidence
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    confident = frame.confident(least)
    return confident & ~frame.dynamic_mask, confident & frame.dynamic_mask


class _EvenChoice:
    """Keeps the same share of every cloud, drawn with a fixed seed, at most `limit` of all points."""

    def __init__(self, total: int, limit: int) -> None:
        self._share = min(1.0, limit / max(1, total))
        self._random = np.random.default_rng(0)

    def kept(self, count: int) -> int:
        """Return how many of so many points are kept."""
        return int(self._share * count)

    def __call__(self, cloud: PointCloud, before: int = 0) -> PointCloud:
        """Return the kept points of a cloud, which comes after `before` points of the same one."""
        count = self.kept(before + len(cloud)) - self.kept(before)
        chosen = self._random.choice(len(cloud), count, replace=False, shuffle=False)
        return PointCloud(cloud.points[chosen], cloud.colors[chosen])


class _Store:
    """Room for the kept points of a clip: in memory, or for a mapped result in files."""

    def __init__(self, result: Result, choice: _EvenChoice, total: int) -> None:
        room = choice.kept(total)
        self._points = zeros_beside(result.depth, np.float32, (room, 3))
        self._colors = zeros_beside(result.depth, np.uint8, (room, 3))
        self._choice, self._seen, self._filled = choice, 0, 0

    def add(self, cloud: PointCloud) -> PointCloud:
        """Keep points of a cloud, and return them as they are stored."""
        kept = self._choice(cloud, self._seen)
        here = slice(self._filled, self._filled + len(kept))
        self._points[here], self._colors[here] = kept.points, kept.colors
        self._seen, self._filled = self._seen + len(cloud), here.stop
        return PointCloud(self._points[here], self._colors[here])

    def all(self) -> PointCloud:
        return PointCloud(self._points[: self._filled], self._colors[: self._filled])


def _camera_size(result: Result, clouds: Iterable[PointCloud]) -> float:
    middle = result.camera_centres.mean(axis=0, dtype=np.float64)
    points = [cloud.points[:: -(-len(cloud) // _MOST_DISTANCES)] for cloud in clouds]
    distances = [np.linalg.norm(some - middle, axis=-1) for some in points]
    return _CAMERA_SIZE * (float(np.median(np.concatenate(distances))) if distances else 1.0)


def camera_mesh(result: Result, size: float) -> CameraMesh:
    """Return the cameras of a result, each as long as `size` from its centre to its corners."""
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
    vertex_frames = np.concatenate([np.repeat(edge_frames[bar_edges], 8), np.repeat(np.arange(frames), 3)])
    return CameraMesh(
        np.concatenate([bars, roofs]), np.concatenate([bar_faces, roof_faces + len(bars)]), colors[vertex_frames]
    )


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
