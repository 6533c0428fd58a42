"""transforms.json of nerfstudio, instant-ngp and Blender's NeRF scenes. Does not import jax.

Poses are world-from-camera in OpenGL's axes (x right, y up, z backward); pixels count from the outer corner of the
first. Numbers of a camera stand at a frame or at the top, for all frames. Depth is .npy, or PNG of 16 bits, a thousand
to the unit, as nerfstudio's `depth_unit_scale_factor` is by default 0.001.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import DISTORTED, PIXEL_CENTRE, from_opengl, intrinsics_matrix
from vggtjax.clips.captures.capture import Capture, checked_sizes, fitted_intrinsics, lenses_of, there
from vggtjax.clips.captures.depth_files import read_npy, read_png
from vggtjax.clips.captures.files import inside
from vggtjax.clips.captures.lens import opencv_lens
from vggtjax.clips.captures.numbers import number, numbers
from vggtjax.clips.media.images import is_image_name
from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError, one_line
from vggtjax.storage.json_values import read_json

NAMES = ("transforms.json", "transforms_train.json")
_MOST_BYTES = 2**26
_PER_UNIT = 1000.0
_PINHOLES = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE"}
_FISHEYE = "OPENCV_FISHEYE"
_SUFFIXES = (".png", ".jpg", ".jpeg")  # of names without one, as Blender's scenes have


def read_nerfstudio(folder: Path, *, whole: bool = True) -> Capture:
    """Read a folder with transforms.json: frames in the natural order of their names.

    `applied_transform` and `applied_scale`, which nerfstudio's own converters add, are undone.
    """
    path = next((folder / name for name in NAMES if (folder / name).is_file()), folder / NAMES[0])
    scene = read_json(path, dict[str, Any], "scene", most_bytes=_MOST_BYTES)
    frames = scene.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} has no list 'frames'; expected a scene of nerfstudio or instant-ngp")
    found = in_order(((_picture(folder, frame, path), frame) for frame in frames), lambda pair: pair[0])
    pictures = tuple(picture for picture, _ in found)
    if len(set(pictures)) < len(pictures):
        raise InputError(f"{path} names a picture twice; expected each once")
    kept, absent = there(pictures, path, whole=whole)
    found, pictures = [found[place] for place in kept], tuple(pictures[place] for place in kept)
    sizes = checked_sizes(pictures, path)
    # Numbers of a frame come before those of all.
    merged = [{**{key: scene[key] for key in scene if key != "frames"}, **frame} for _, frame in found]
    models = [_model(camera, path) for camera in merged]
    cameras = [_camera(camera, size, path) for camera, size in zip(merged, sizes, strict=True)]
    lenses = lenses_of(
        opencv_lens(camera, matrix, size, path, model=model)
        for camera, model, (matrix, size) in zip(merged, models, cameras, strict=True)
    )
    depths = [_depth_file(folder, frame, path, whole=whole) for _, frame in found]
    return Capture(
        "nerfstudio",
        folder,
        pictures,
        sizes,
        fitted_intrinsics([matrix for matrix, _ in cameras], [size for _, size in cameras], sizes, path),
        from_opengl(_original(scene, [frame for _, frame in found], path), path),
        lenses=lenses,
        depth_files=tuple(depths) if any(depths) else None,
        read_depth_file=_read_depth,
        absent=absent,
        notes=(DISTORTED,) * (lenses is not None),
    )


def _picture(folder: Path, frame: Mapping[str, Any], source: Path) -> Path:
    name = frame.get("file_path")
    if not isinstance(name, str):
        raise InputError(f"{source} has a frame without a 'file_path'; expected the path of its picture")
    path = inside(folder, name, source)
    if is_image_name(path):
        return path
    named = [path.with_name(path.name + suffix) for suffix in _SUFFIXES]
    return next((path for path in named if path.is_file()), named[0])


def _model(camera: Mapping[str, Any], source: Path) -> str:
    """Return the camera's model, in COLMAP's words; instant-ngp tells a fisheye by a field of its own."""
    model = camera.get("camera_model", "PINHOLE")
    model = model.upper() if isinstance(model, str) else repr(model)
    if model not in (*_PINHOLES, _FISHEYE):
        expected = ", ".join(sorted((*_PINHOLES, _FISHEYE)))
        raise InputError(f"{source} has a camera of the model {one_line(model, 40)}; expected one of {expected}")
    return _FISHEYE if camera.get("is_fisheye") else model


def _camera(
    camera: Mapping[str, Any], picture: tuple[int, int], source: Path
) -> tuple[Float64[np.ndarray, "3 3"], tuple[int, int]]:
    """Return the intrinsics of a frame, and the width and height of the pictures that they are for."""
    width, height = (int(number(camera, key, source, side)) for key, side in zip("wh", picture, strict=True))
    if min(width, height) < 1:
        raise InputError(f"{source} has a camera of {width} x {height} pixels; expected sizes above 0")
    fx, fy = (_focal(camera, axis, side, source) for axis, side in (("x", width), ("y", height)))
    fx = fy if fx is None else fx
    if fx is None:
        raise InputError(f"{source} has no focal length; expected fl_x, or camera_angle_x in radians")
    fy = fx if fy is None else fy
    cx, cy = number(camera, "cx", source, width / 2), number(camera, "cy", source, height / 2)
    return intrinsics_matrix(fx, fy, cx, cy, first_pixel=PIXEL_CENTRE, source=source), (width, height)


def _focal(camera: Mapping[str, Any], axis: str, side: int, source: Path) -> float | None:
    if f"fl_{axis}" in camera:
        return number(camera, f"fl_{axis}", source)
    if (key := f"camera_angle_{axis}") not in camera:
        return None
    angle = number(camera, key, source)
    if not 0 < angle < math.pi:
        raise InputError(f"{source} has a {key} of {angle:g}; expected radians in (0, pi)")
    return side / 2 / math.tan(angle / 2)


def _original(scene: Mapping[str, Any], frames: list[Any], source: Path) -> Float64[np.ndarray, "S 4 4"]:
    """Return the poses in the world of before nerfstudio's converters moved it."""
    poses = np.stack([_matrix(frame, "transform_matrix", source) for frame in frames])
    if "applied_scale" in scene:
        scale = number(scene, "applied_scale", source)
        if not scale > 0:
            raise InputError(f"{source} has an applied_scale of {scale:g}; expected a number above 0")
        poses[:, :3, 3] /= scale
    if "applied_transform" in scene:
        applied = _matrix(scene, "applied_transform", source)
        if abs(np.linalg.det(applied)) < 1e-6:
            raise InputError(f"{source} has an applied_transform without an inverse; expected a rotation")
        poses = np.linalg.inv(applied) @ poses
    return poses


def _matrix(values: Mapping[str, Any], key: str, source: Path) -> Float64[np.ndarray, "4 4"]:
    rows = numbers(values, key, ((4, 4), (3, 4)), source)
    return rows if len(rows) == 4 else np.vstack([rows, [0, 0, 0, 1]])


def _depth_file(folder: Path, frame: Mapping[str, Any], source: Path, *, whole: bool) -> Path | None:
    if (name := frame.get("depth_file_path")) is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"{source} has a 'depth_file_path' that is no text; expected the path of a depth map")
    path = inside(folder, name, source)
    if whole and not path.is_file():
        raise InputError(f"{path} is missing, but {source} names it; get the capture whole")
    return path if path.is_file() else None


def _read_depth(path: Path) -> Float32[np.ndarray, "h w"]:
    if path.suffix.lower() == ".npy":
        return read_npy(path) / np.float32(_PER_UNIT)
    return read_png(path, _PER_UNIT)
