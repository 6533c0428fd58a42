"""A COLMAP model of a result, by pycolmap: pinhole cameras, poses, static points, and the tracks that follow them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image

from vggtjax.results.exports.views import View, placed, rigid
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result
from vggtjax.results.tracks import SEEN

_FEWEST = 2  # frames of a track


def write_colmap(
    folder: Path, items: Iterator[View], result: Result, cloud: PointCloud, form: Literal["binary", "text"] = "binary"
) -> None:
    """Write images/, masks/ and sparse/0/ into an empty folder.

    Every frame has a PINHOLE camera of its own, as its focal lengths are its own. masks/NAME.png are 0 where pixels
    move or are padding, as COLMAP's feature extractor takes them; a frame without mask and padding has
    none. The points of the cloud come from depth, so that no
    frame observed them: their tracks are empty, and their errors -1, COLMAP's sign for unknown ones. Points that the
    result's tracks follow have these tracks, and the errors that are measured by them.
    """
    import pycolmap

    for name in ("images", "sparse/0"):
        (folder / name).mkdir(parents=True)
    model = pycolmap.Reconstruction()
    tracked = tracked_points(result)
    tracks: list[list[Any]] = [[] for _ in tracked.points]
    for number, view in enumerate(items, start=1):
        view.write_picture(folder / "images")
        if view.needs_mask:
            Image.fromarray(view.static.astype(np.uint8) * 255).save(placed(folder / "masks", f"{view.name}.png"))
        height, width = view.size
        K = view.frame.intrinsics
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=number, model="PINHOLE", width=width, height=height,
                params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            )
        )  # fmt: skip
        indices, pixels = tracked.in_picture(number - 1, result, view)
        image = pycolmap.Image(name=view.name, keypoints=pixels, camera_id=number, image_id=number)
        pose = view.camera_from_world
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
        for place, index in enumerate(indices.tolist()):
            tracks[index].append(pycolmap.TrackElement(number, place))
    for point, color, track in zip(tracked.points, tracked.colors, tracks, strict=True):
        if len(track) > 1:
            model.add_point3D(point, pycolmap.Track(track), color)
    if model.num_points3D():
        model.update_point_3d_errors()
    for point, color in zip(cloud.points.astype(np.float64), cloud.colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    (model.write_binary if form == "binary" else model.write_text)(str(folder / "sparse/0"))


class TrackedPoints(NamedTuple):
    """Points of queries, where the depth of the queries' own frames puts them, and their tracks."""

    points: Float64[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    positions: Float64[np.ndarray, "S N 2"]  # pixels of the result's frames; pixel edges are at whole numbers
    seen: Bool[np.ndarray, "S N"]

    def in_picture(self, number: int, result: Result, view: View) -> tuple[np.ndarray, Float64[np.ndarray, "K 2"]]:
        """Return which points a frame saw, and where in its picture, which may have another size."""
        own, shown = result.intrinsics[number].astype(np.float64), view.frame.intrinsics
        scale = np.diag(shown)[:2] / np.diag(own)[:2]
        pixels = (self.positions[number] - own[:2, 2]) * scale + shown[:2, 2]
        height, width = view.size
        seen = self.seen[number] & ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        return np.flatnonzero(seen), pixels[seen]


def tracked_points(result: Result) -> TrackedPoints:
    """Return the tracked points of static, valid pixels that at least two frames saw; none without tracks."""
    positions, visibility, own = result.track_positions, result.track_visibility, result.track_frames
    S, H, W = result.depth.shape
    if positions is None or visibility is None or own is None:
        return TrackedPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((S, 0, 2)), np.zeros((S, 0), bool))
    query = positions[own, np.arange(len(own))].astype(np.float64)
    columns, rows = (np.clip(query[:, axis].astype(int), 0, side - 1) for axis, side in enumerate((W, H)))
    static = result.valid_pixels[own, rows, columns] & ~result.dynamic_mask[own, rows, columns]
    poses = np.stack([rigid(pose) for pose in result.camera_from_world])
    K = result.intrinsics[own].astype(np.float64)
    depth = result.depth[own, rows, columns].astype(np.float64)
    across = (query - K[:, :2, 2]) / np.stack([K[:, 0, 0], K[:, 1, 1]], axis=1)
    inside = np.column_stack([across, np.ones(len(own))]) * depth[:, None]
    points = np.einsum("nij,ni->nj", poses[own, :, :3], inside - poses[own, :, 3])
    away = np.einsum("sj,nj->sn", poses[:, 2, :3], points) + poses[:, 2, 3:]
    seen = (visibility >= SEEN) & (away > 0) & static
    kept = seen.sum(axis=0) >= _FEWEST
    colors = result.images[own, rows, columns]
    return TrackedPoints(points[kept], colors[kept], positions[:, kept].astype(np.float64), seen[:, kept])
