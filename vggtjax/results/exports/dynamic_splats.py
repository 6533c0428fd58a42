"""A result as a data set for trainers of dynamic splats and radiance fields: frames with times, cameras, masks, points.

The layout is that of Nerfies (https://github.com/google/nerfies#datasets) with what DyCheck adds for its iPhone
sequences (https://github.com/KAIR-BAIR/dycheck/blob/main/docs/DATASETS.md): cameras have the rotation of camera from
world and the centre, depth is in their unit, and scene.json has the middle and the scale that bring the scene into a
box whose diagonal is 1. transforms.json describes the same frames to nerfstudio. Frames are named CAMERA_TIME, 0_00000
first.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image

from vggtjax.results.exports.nerfstudio import lens_of, transform_matrix
from vggtjax.results.exports.views import View, of_one_size
from vggtjax.results.gltf_animation import frame_rate, frame_times
from vggtjax.results.point_cloud import PointCloud, ply_header, write_ply
from vggtjax.results.result import Result

_HELD_OUT = 8  # every so many frames one is for testing
_POINTS = "points3D_downsample2.ply"  # the name that 4DGaussians reads
_OUTLIERS = (1.0, 99.0)  # percentiles of the static points, between which the box lies
_NEAR, _FAR = 0.75, 1.25  # of the nearest and the farthest depth, but for a thousandth
_WITH_NORMALS = np.dtype([("points", "<f4", 3), ("normals", "<f4", 3), ("colors", "u1", 3)])


def write_dynamic_splats(
    folder: Path, items: Iterator[View], result: Result, static: PointCloud, moving: Sequence[PointCloud]
) -> None:
    """Write the data set into an empty folder.

    rgb/1x/ and rgb/2x/ (half the size) are the pictures, transparent where the model saw nothing; depth/1x/ is 0 where
    unknown; mask/1x/ is 255 where the world moves; moving/ has the moving points of each frame (neither is there for a
    result without a mask); points.npy and the .ply the static ones. Every eighth frame is for testing, never the first
    nor the last.

    Raises InputError for pictures of several sizes.
    """
    of_mask = ("mask/1x", "moving") if result.has_mask else ()
    for name in ("camera", "rgb/1x", "rgb/2x", "depth/1x", "splits", *of_mask):
        (folder / name).mkdir(parents=True)
    times = frame_times(result)[:-1]
    shares = times / max(times[-1], np.finfo(np.float64).tiny)  # from 0 to 1
    ids = [f"0_{number:05d}" for number in range(len(times))]
    frames: list[dict[str, Any]] = []
    ends, ups = [], []
    for number, view in enumerate(of_one_size(items, "a data set of dynamic splats")):
        name = ids[number]
        _write_frame(folder, name, view)
        if view.has_mask:
            write_ply(folder / f"moving/{name}.ply", moving[number])
        _dump(folder / f"camera/{name}.json", _camera(view))
        frames.append({
            "file_path": f"rgb/1x/{name}.png",
            **lens_of(view),
            "time": float(shares[number]),
            "transform_matrix": transform_matrix(view),
        })  # fmt: skip
        depth = view.frame.depth[view.frame.valid]
        ends.append(np.quantile(depth, [0.001, 0.999]) if depth.size else np.array([np.inf, 0]))
        ups.append(-view.camera_from_world[1, :3])
    np.save(folder / "points.npy", static.points, allow_pickle=False)
    _write_with_normals(folder / _POINTS, static)

    tested = ids[min(_HELD_OUT // 2, (len(ids) - 1) // 2) : -1 : _HELD_OUT] if len(ids) > 2 else []
    trained = [name for name in ids if name not in tested]
    for split, names in (("train", trained), ("val", tested)):
        numbers = [ids.index(name) for name in names]
        _dump(
            folder / f"splits/{split}.json", {"frame_names": names, "camera_ids": [0] * len(names), "time_ids": numbers}
        )
    count = {"count": len(ids), "num_exemplars": len(trained)}
    _dump(folder / "dataset.json", count | {"ids": ids, "train_ids": trained, "val_ids": tested})
    facts = {
        name: {"warp_id": number, "appearance_id": number, "camera_id": 0, "time_id": number, "time": share}
        for number, (name, share) in enumerate(zip(ids, shares.tolist(), strict=True))
    }
    _dump(folder / "metadata.json", facts)
    splits = {"train_filenames": trained, "val_filenames": tested, "test_filenames": tested}
    named = {key: [f"rgb/1x/{name}.png" for name in names] for key, names in splits.items()}
    scene = {"camera_model": "OPENCV", "ply_file_path": _POINTS, **named, "frames": frames}
    _dump(folder / "transforms.json", scene)
    _write_scene(folder, result, static, np.array(ends), np.mean(ups, axis=0))


def _write_frame(folder: Path, name: str, view: View) -> None:
    frame = view.frame
    picture = Image.fromarray(frame.image)
    if not frame.seen.all():
        picture.putalpha(Image.fromarray(frame.seen.astype(np.uint8) * 255))
    height, width = view.size
    half = picture.resize((max(round(width / 2), 1), max(round(height / 2), 1)), Image.Resampling.BOX)
    for scale, image in ((1, picture), (2, half)):
        image.save(folder / f"rgb/{scale}x/{name}.png", compress_level=3)
    depth = np.where(frame.valid, frame.depth, 0).astype(np.float32)
    np.save(folder / f"depth/1x/{name}.npy", depth[..., None], allow_pickle=False)
    if view.has_mask:
        Image.fromarray(frame.dynamic_mask.astype(np.uint8) * 255).save(folder / f"mask/1x/{name}.png")


def _camera(view: View) -> dict[str, Any]:
    K, (height, width) = view.frame.intrinsics, view.size
    return {
        "orientation": view.camera_from_world[:, :3].tolist(),
        "position": view.world_from_camera[:3, 3].tolist(),
        "focal_length": K[0, 0],
        "pixel_aspect_ratio": K[1, 1] / K[0, 0],
        "principal_point": [K[0, 2], K[1, 2]],
        "skew": K[0, 1],
        "radial_distortion": [0.0] * 3,
        "tangential_distortion": [0.0] * 2,
        "image_size": [width, height],
    }


def _write_scene(
    folder: Path, result: Result, static: PointCloud, ends: Float64[np.ndarray, "S 2"], up: Float64[np.ndarray, " 3"]
) -> None:
    """Write scene.json and extra.json; the box of the latter, near and far are in the scaled scene."""
    centres = result.camera_centres.astype(np.float64)
    box = np.stack([centres.min(axis=0), centres.max(axis=0)])
    if len(static):
        low, high = np.percentile(static.points.astype(np.float64), _OUTLIERS, axis=0)
        box = np.stack([np.minimum(box[0], low), np.maximum(box[1], high)])
    center, diagonal = box.mean(axis=0), float(np.linalg.norm(box[1] - box[0]))
    scale = 1 / diagonal if diagonal > 0 else 1.0
    far = _FAR * float(ends[:, 1].max()) * scale
    near = min(_NEAR * float(ends[:, 0].min()) * scale, far)
    _dump(folder / "scene.json", {"scale": scale, "center": center.tolist(), "near": near, "far": far})
    extra = {"factor": 1, "fps": frame_rate(result), "bbox": ((box - center) * scale).tolist()}
    _dump(folder / "extra.json", extra | {"lookat": [0.0] * 3, "up": (up / max(np.linalg.norm(up), 1e-12)).tolist()})


def _write_with_normals(path: Path, cloud: PointCloud) -> None:
    """Write a cloud with normals of 0, which readers of splats ask for and do not use."""
    vertices = np.zeros(len(cloud), _WITH_NORMALS)
    vertices["points"], vertices["colors"] = cloud.points, cloud.colors
    path.write_bytes(ply_header(_WITH_NORMALS, len(cloud)) + vertices.tobytes())


def _dump(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=1), encoding="utf-8")
