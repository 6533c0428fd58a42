"""A COLMAP model of a result: pinhole cameras, poses, and static points, by pycolmap."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from vggtjax.results.exports.tracked import tracked_points
from vggtjax.results.exports.views import View, placed
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result


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
