"""A result as a scene of Blender: a script that Blender runs, and the files that it reads.

Blender has no format of its own that a small library writes. A script needs none, and brings what USD and glTF leave
out: the pictures behind the camera, the frame rate and range, focal length and principal point of every frame.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from vggtjax.results.exports.views import View, of_one_size
from vggtjax.results.gltf_animation import frame_rate
from vggtjax.results.point_cloud import PointCloud, write_ply
from vggtjax.results.result import Result
from vggtjax.results.shown import middle_and_radius

_SCRIPT = Path(__file__).with_name("blender_scene.py")
_NEAR, _FAR = 1e-3, 1e3  # of the distance of the scene
_MOST_SPACINGS = 2000  # of points, of which the median is taken


def write_blender(
    folder: Path, items: Iterator[View], result: Result, static: PointCloud, moving: Sequence[PointCloud]
) -> None:
    """Write scene.py, scene.json, pictures/, static.ply and, if a mask tells what moves, moving/ into an empty folder.

    Frames count from 1. scene.json has poses as everywhere here, world from camera in OpenCV's axes. Raises InputError
    for pictures of several sizes, as a scene of Blender has one.
    """
    for name in ("pictures", "moving") if result.has_mask else ("pictures",):
        (folder / name).mkdir()
    frames: list[dict[str, Any]] = []
    size, suffix = (0, 0), ""
    for number, view in enumerate(of_one_size(items, "a scene of Blender"), start=1):
        if number == 1:
            size, suffix = view.size, ".png" if view.name.endswith(".png") else ".jpg"
        view = view._replace(name=f"{number:06d}{suffix}")  # Blender counts the digits of a sequence on
        view.write_picture(folder / "pictures")
        frames.append(_frame(view))
    write_ply(folder / "static.ply", static)
    for number, cloud in enumerate(moving if result.has_mask else (), start=1):
        write_ply(folder / f"moving/{number:06d}.ply", cloud)
    distance = middle_and_radius(result)[1]
    scene = {
        "name": "vggtjax",
        "width": size[1],
        "height": size[0],
        "frames_a_second": frame_rate(result),
        "near": _NEAR * distance,
        "far": _FAR * distance,
        "point_radius": _spacing(static) / 2,
        "frames": frames,
    }
    (folder / "scene.json").write_text(json.dumps(scene, indent=1), encoding="utf-8")
    shutil.copyfile(_SCRIPT, folder / "scene.py")


def _frame(view: View) -> dict[str, Any]:
    K = view.frame.intrinsics
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return {"picture": f"pictures/{view.name}", "time": view.time, **lens} | {
        "world_from_camera": view.world_from_camera.tolist()
    }


def _spacing(cloud: PointCloud) -> float:
    """Return the median distance of points from their nearest neighbours; 0.01 for fewer than two points."""
    if len(cloud) < 2:
        return 0.01
    some = cloud.points[:: -(-len(cloud) // _MOST_SPACINGS)]
    return float(np.median(KDTree(cloud.points).query(some, k=2)[0][:, 1]))
