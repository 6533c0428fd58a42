"""A COLMAP model of a result: pinhole cameras, poses, and static points with their tracks, by pycolmap."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from vggtjax.exports.observations import Observations, view_observations
from vggtjax.exports.views import View


def write_colmap(
    folder: Path, items: Iterator[View], observations: Observations, form: Literal["binary", "text"] = "binary"
) -> None:
    """Write images/, masks/ and sparse/0/ into an empty folder.

    Every frame has a PINHOLE camera of its own, as its focal lengths are its own. masks/NAME.png are 0 where pixels
    move or are padding, as COLMAP's feature extractor takes them. Points stand where the result has them, and each
    observation where the camera projects its point, so that the model has no reprojection error of its own.
    """
    import pycolmap

    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    model = pycolmap.Reconstruction()
    tracks: list[list[Any]] = [[] for _ in observations.points]
    for number, (view, indices, pixels) in enumerate(view_observations(items, observations), start=1):
        view.write_picture(folder / "images")
        Image.fromarray(view.static.astype(np.uint8) * 255).save(folder / "masks" / f"{view.name}.png")
        height, width = view.size
        K = view.frame.intrinsics
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=number, model="PINHOLE", width=width, height=height,
                params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            )
        )  # fmt: skip
        image = pycolmap.Image(name=view.name, keypoints=pixels, camera_id=number, image_id=number)
        pose = view.camera_from_world
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
        for place, index in enumerate(indices.tolist()):
            tracks[index].append(pycolmap.TrackElement(number, place))
    for point, color, track in zip(observations.points, observations.colors, tracks, strict=True):
        if track:
            model.add_point3D(point, pycolmap.Track(track), color)
    model.update_point_3d_errors()
    (model.write_binary if form == "binary" else model.write_text)(str(folder / "sparse/0"))
