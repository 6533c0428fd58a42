"""A result as a data set of nerfstudio: transforms.json with pictures, depth, masks and points.

The fields are those of nerfstudio's data conventions (https://docs.nerf.studio/quickstart/data_conventions.html): poses
are world-from-camera in OpenGL's axes (x right, y up, z backward), masks are 0 where pixels are not trained on, and
depth files hold a thousand times the depth, as the parser's default `depth_unit_scale_factor` is 0.001.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vggtjax.results.exports.views import View, placed
from vggtjax.results.point_cloud import PointCloud, write_ply

_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # of the camera's axes
_DEPTH_SCALE = 1000.0


def write_nerfstudio(folder: Path, items: Iterator[View], points: PointCloud) -> None:
    """Write transforms.json, images/, depth/, masks/ and points.ply into an empty folder; moving pixels are masked.

    All frames have a mask, as nerfstudio asks, or none, where no frame needs one.
    """
    for name in ("images", "depth", "masks"):
        (folder / name).mkdir()
    frames: list[dict[str, Any]] = []
    has_masks = False
    for view in items:
        stem = Path(view.name).with_suffix("").as_posix()
        view.write_picture(folder / "images")
        depth = np.where(view.frame.valid, view.frame.depth * np.float32(_DEPTH_SCALE), 0).astype(np.float32)
        np.save(placed(folder, f"depth/{stem}.npy"), depth, allow_pickle=False)
        Image.fromarray(view.static.astype(np.uint8) * 255).save(placed(folder, f"masks/{stem}.png"))
        frames.append(_frame(view, stem))
        has_masks |= view.needs_mask
    if not has_masks:
        shutil.rmtree(folder / "masks")
        frames = [{key: value for key, value in frame.items() if key != "mask_path"} for frame in frames]
    write_ply(folder / "points.ply", points)
    scene = {"camera_model": "OPENCV", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(scene, indent=1), encoding="utf-8")


def lens_of(view: View) -> dict[str, Any]:
    """Return size, focal lengths, principal point and a distortion of 0, as a frame of transforms.json has them."""
    K, (height, width) = view.frame.intrinsics, view.size
    sizes = {"w": width, "h": height, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return sizes | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)


def transform_matrix(view: View) -> list[list[float]]:
    """Return world from camera in OpenGL's axes."""
    return (view.world_from_camera @ _FROM_OPENCV).tolist()


def _frame(view: View, stem: str) -> dict[str, Any]:
    return {
        "file_path": f"images/{view.name}",
        "depth_file_path": f"depth/{stem}.npy",
        "mask_path": f"masks/{stem}.png",
        **lens_of(view),
        "time": view.time,
        "transform_matrix": transform_matrix(view),
    }
