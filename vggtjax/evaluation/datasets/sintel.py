"""MPI Sintel's training sequences with depth and cameras, final pass. Does not import jax.

training/final/<sequence>/frame_%04d.png, and of the same names training/depth/*.dpt, in metres, and
training/camdata_left/*.cam: a tag, K as nine 64-bit floats, camera-from-world as twelve. Pixels count from the centre
of the first: the principal point of 1024 x 436 pictures is (511.5, 217.5), their middle.
http://sintel.is.tue.mpg.de/depth, `sintel_io.py`
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.captures.cameras import PIXEL_CENTRE, checked_intrinsics, world_from_camera_of
from vggtjax.captures.depth_files import SINTEL_TAG, read_dpt
from vggtjax.captures.files import files, read_bytes
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.folders import subfolders
from vggtjax.evaluation.datasets.frames import FrameChoice
from vggtjax.evaluation.datasets.maps import depth_reader
from vggtjax.evaluation.datasets.sequence import LabelledSequence, Opener

_CAM_BYTES = 4 + 8 * (9 + 12)


def sintel(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder training/, or of the folder around it."""
    for folder in (root / "training", root):
        if names := [child.name for child in subfolders(folder / "final")]:
            return {name: partial(_read, folder, name) for name in names}
    raise InputError(f"{root} holds no sequence of Sintel; expected training/final with folders of frames")


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


def _read(training: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures = frames.of(list(files(training / "final" / name, ".png").values()), name)
    depths = files(training / "depth" / name, ".dpt")
    depth, notes = depth_reader(pictures, [depths.get(path.stem) for path in pictures], read_dpt)
    cams = files(training / "camdata_left" / name, ".cam")
    poses = intrinsics = None
    if missing := [path.stem for path in pictures if path.stem not in cams]:
        notes += (f"{len(missing)} of {len(pictures)} frames have no camera, {missing[0]} first; no cameras",)
    else:
        source = training / "camdata_left" / name
        matrices, camera_from_world = zip(*(read_cam(cams[path.stem]) for path in pictures), strict=True)
        intrinsics = checked_intrinsics(np.stack(matrices), source)
        intrinsics[:, :2, 2] += PIXEL_CENTRE
        poses = world_from_camera_of(np.stack(camera_from_world), source)
    return LabelledSequence(name, tuple(pictures), depth, world_from_camera=poses, intrinsics=intrinsics, notes=notes)
