"""MPI Sintel. Does not import jax.

MPI Sintel's training sequences with depth and cameras, final pass. training/final/<sequence>/frame_%04d.png, and of
the same names training/depth/*.dpt, in metres, and training/camdata_left/*.cam: a tag, K as nine 64-bit floats,
camera-from-world as twelve. Pixels count from the centre of the first: the principal point of 1024 x 436 pictures is
(511.5, 217.5), their middle. http://sintel.is.tue.mpg.de/depth, `sintel_io.py`
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.captures.cameras import (
    PIXEL_CENTRE,
    checked_intrinsics,
    world_from_camera_of,
)
from vggtjax.clips.captures.depth_files import SINTEL_TAG, read_dpt
from vggtjax.clips.captures.files import files, read_bytes
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import pictures_of, subfolders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    left_out,
    map_reader,
    unpictured,
)

_CAM_BYTES = 4 + 8 * (9 + 12)


def sintel(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder training/, or of the folder around it."""
    for folder in (root / "training", root):
        if names := [child.name for child in subfolders(folder / "final")]:
            return {name: partial(_read_sintel, folder, name) for name in names}
    raise InputError(f"{root} holds no sequence of Sintel; expected {root}/training/final/SEQUENCE/frame_*.png")


def read_cam(path: Path) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3 4"]]:
    """Read a camera: K, with pixels counted from the centre of the first, and camera-from-world."""
    data = read_bytes(path)
    if data[:4] != SINTEL_TAG or len(data) != _CAM_BYTES:
        raise InputError(
            f"{path} has {len(data)} bytes and starts with {data[:4]!r}; expected {_CAM_BYTES} that start with "
            f"{SINTEL_TAG!r}, the tag of a Sintel camera"
        )
    values = np.frombuffer(data, "<f8", offset=4).astype(np.float64)
    return values[:9].reshape(3, 3), values[9:].reshape(3, 4)


def _read_sintel(training: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    every = pictures_of(training / "final" / name, ".png")
    pictures = frames.of(every, name)
    source = training / "camdata_left" / name
    depths, cams = files(training / "depth" / name, ".dpt"), files(source, ".cam")
    expected = training / "depth" / name / "*.dpt"
    depth, gaps, notes = map_reader("depth", pictures, [depths.get(path.stem) for path in pictures], read_dpt, expected)
    gaps += unpictured(frames, (path.stem for path in every), {*depths, *cams}, training / "final" / name)
    poses = intrinsics = None
    cameras = [read_cam(cams[path.stem]) if path.stem in cams else None for path in pictures]
    seen = [camera is not None and all(np.isfinite(array).all() for array in camera) for camera in cameras]
    lost = [path.stem for path, found in zip(pictures, seen, strict=True) if not found]
    if len(lost) == len(pictures):
        notes += (f"it has no cameras; expected {source / '*.cam'}",)
    else:
        found = [camera for camera, sees in zip(cameras, seen, strict=True) if camera is not None and sees]
        matrices, camera_from_world = (np.stack(values) for values in zip(*found, strict=True))
        intrinsics = np.tile(checked_intrinsics(matrices, source)[:1], (len(pictures), 1, 1))
        intrinsics[seen] = matrices
        intrinsics[:, :2, 2] += PIXEL_CENTRE
        poses = np.full((len(pictures), 4, 4), np.nan)
        poses[seen] = world_from_camera_of(camera_from_world, source)
        gaps += left_out("poses", lost, len(pictures), "have no camera", source / "*.cam")
    return LabelledSequence(
        name, tuple(pictures), depth, world_from_camera=poses, intrinsics=intrinsics, notes=notes, left_out=gaps
    )
