"""The raw data that Polycam exports of a lidar capture (developer mode). Does not import jax.

keyframes/images and keyframes/cameras hold ARKit's pictures and poses, corrected_images and corrected_cameras those
after Polycam's optimisation, without lens distortion. A camera is JSON: width, height, fx, fy, cx, cy, and t_00 to
t_23, three rows of world-from-camera in ARKit's axes: the camera looks along -z, the world's y is up, the unit is a
metre. depth/ is PNG of 16 bits in millimetres, with fewer pixels than the pictures; confidence/ has 0 where it is low.
Files are named after the time in microseconds. Pixels are taken to count from the outer corner of the first.
https://github.com/PolyCam/polyform
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import DISTORTED, PIXEL_CENTRE, from_opengl, intrinsics_matrix
from vggtjax.clips.captures.capture import Capture, checked_sizes, fitted_intrinsics, left_out, lenses_of
from vggtjax.clips.captures.depth_files import read_png
from vggtjax.clips.captures.files import files
from vggtjax.clips.captures.lens import Lens, opencv_lens
from vggtjax.clips.captures.numbers import number
from vggtjax.clips.captures.pictures import PNG, opening
from vggtjax.clips.media.images import is_image_name
from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError
from vggtjax.storage.json_values import read_json

_KEYFRAMES = "keyframes"
_PER_METRE = 1000.0
_NOT_OPTIMISED = "its poses are ARKit's own: Polycam did not optimise them"  # a note


def is_polycam(folder: Path) -> bool:
    """Return whether a folder has the names of Polycam's raw data; a folder keyframes alone may hold anything."""
    return any((folder / _KEYFRAMES / name).is_dir() for name in ("cameras", "corrected_cameras"))


def read_polycam(folder: Path, *, whole: bool = True) -> Capture:
    """Read raw data of Polycam: the optimised cameras with their pictures where there are some, else ARKit's."""
    root = folder / _KEYFRAMES
    corrected = bool(files(root / "corrected_cameras", ".json")) and (root / "corrected_images").is_dir()
    prefix = "corrected_" if corrected else ""
    cameras = files(root / f"{prefix}cameras", ".json")
    if not cameras:
        raise InputError(f"{root} has no cameras/*.json; export Polycam's raw data, with developer mode on")
    pictures = _pictures(root / f"{prefix}images")
    alone = [name for name in cameras if name not in pictures]
    if alone and (whole or len(alone) == len(cameras)):
        raise InputError(f"{root} has the camera {alone[0]} and no picture for it; get the capture whole")
    cameras = {name: path for name, path in cameras.items() if name in pictures}
    lost = [name for name in pictures if name not in cameras]
    paths = tuple(pictures[name] for name in cameras)
    sizes = checked_sizes(paths, root)
    read = [_camera(path) for path in cameras.values()]
    depths = files(root / "depth", ".png")
    missing = left_out(lost, len(pictures), "camera")
    return Capture(
        "polycam",
        folder,
        paths,
        sizes,
        fitted_intrinsics([camera.intrinsics for camera in read], [camera.size for camera in read], sizes, root),
        from_opengl(np.stack([camera.pose for camera in read]), root),
        lenses=None if corrected else lenses_of(camera.lens for camera in read),
        has_unknown_lens=not corrected and not any(camera.lens for camera in read),
        metric=True,
        depth_files=tuple(depths.get(name) for name in cameras) if depths else None,
        read_depth_file=_read_depth,
        timestamps=_times(list(cameras)),
        absent=tuple(alone),
        left_out=missing,
        notes=missing + (() if corrected else (_NOT_OPTIMISED, DISTORTED)),
    )


def _pictures(folder: Path) -> dict[str, Path]:
    found = folder.iterdir() if folder.is_dir() else ()
    paths = [path for path in found if is_image_name(path) and not path.name.startswith(".")]
    return {path.stem: path for path in in_order(paths)}


class _Camera(NamedTuple):
    intrinsics: Float64[np.ndarray, "3 3"]
    size: tuple[int, int]  # width, height
    pose: Float64[np.ndarray, "4 4"]
    lens: Lens | None  # of OpenCV's coefficients, where the file has some


def _camera(path: Path) -> _Camera:
    values = read_json(path, dict[str, Any], "camera")
    width, height = int(number(values, "width", path)), int(number(values, "height", path))
    if min(width, height) < 1:
        raise InputError(f"{path} has a picture of {width} x {height} pixels; expected sizes above 0")
    fx, fy, cx, cy = (number(values, key, path) for key in ("fx", "fy", "cx", "cy"))
    rows = [[number(values, f"t_{row}{column}", path) for column in range(4)] for row in range(3)]
    matrix = intrinsics_matrix(fx, fy, cx, cy, first_pixel=PIXEL_CENTRE, source=path)
    lens = opencv_lens(values, matrix, (width, height), path)
    return _Camera(matrix, (width, height), np.array([*rows, [0, 0, 0, 1]], np.float64), lens)


def _read_depth(path: Path) -> Float32[np.ndarray, "h w"]:
    """Read metres, 0 where the confidence is low."""
    depth = read_png(path, _PER_METRE)
    confidence = path.parent.with_name("confidence") / path.name
    if not confidence.is_file():
        return depth
    with opening(confidence, PNG) as image:
        sure = np.asarray(image.convert("L")) > 0
    if sure.shape != depth.shape:
        raise InputError(f"{confidence} has shape {sure.shape}; expected {depth.shape}, that of the depth")
    return np.where(sure, depth, np.float32(0))


def _times(names: list[str]) -> Float64[np.ndarray, " S"] | None:
    if not all(name.isdecimal() and len(name) <= 20 for name in names):
        return None
    times = np.array([int(name) * 1e-6 for name in names])
    return times if (np.diff(times) > 0).all() else None
