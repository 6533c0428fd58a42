"""TAPVid-3D and WorldTrack: an .npz for each video, with its pictures and true tracks. Does not import jax.

The arrays: `images_jpeg_bytes`, a JPEG for each frame; `tracks_XYZ` [S, N, 3], metres in the camera; `visibility`
[S, N]; `fx_fy_cx_cy` in pixels; `extrinsics_w2c` [S, 4, 4], camera from world, absent where the camera stands still.
Folders of files: `adt`, `drivetrack`, `pstudio` of TAPVid-3D, whose README has the format
(https://github.com/google-deepmind/tapnet/tree/main/tapnet/tapvid3d), `adt_mini`, `pstudio_mini`, `po_mini`, `ds_mini`
of WorldTrack (https://github.com/HavenFeng/St4RTrack), whose evaluation takes the first 64 frames and the pixel in
which a projected point lies: pixel edges are at whole numbers.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from vggtjax.clips.captures.cameras import checked_intrinsics, world_from_camera_of
from vggtjax.clips.captures.files import files
from vggtjax.clips.captures.pictures import picture_size
from vggtjax.clips.captures.unpacked import Unpacked
from vggtjax.errors import InputError, ResultError
from vggtjax.research.evaluation.datasets.folders import subfolders
from vggtjax.research.evaluation.datasets.sequence import FrameChoice, LabelledSequence, Opener
from vggtjax.research.evaluation.datasets.true_tracks import TrueTracks, seen_inside
from vggtjax.storage.arrays import read_arrays, read_headers

_NEEDED = {"images_jpeg_bytes": "S", "tracks_XYZ": "f", "visibility": "biuf", "fx_fy_cx_cy": "fiu"}
_OPTIONAL = {"extrinsics_w2c": "f"}
_ENDING = ".npz"


def tapvid3d(root: Path) -> dict[str, Opener]:
    """Find the videos of a folder of .npz files, or of a folder of such folders, named FOLDER/VIDEO."""
    found = files(root, _ENDING)
    for folder in subfolders(root):
        found |= {f"{folder.name}/{name}": path for name, path in files(folder, _ENDING).items()}
    if not found:
        raise InputError(f"{root} holds no video with tracks; expected {root / '*.npz'} or {root / 'adt' / '*.npz'}")
    return {name: partial(_read, path, name) for name, path in found.items()}


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a video; nothing is unpickled."""
    try:
        kinds = {name: header.dtype.kind for name, header in read_headers(path).items()}
        arrays = read_arrays(path, [name for name in kinds if name in _NEEDED | _OPTIONAL])
    except ResultError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    for name, kind in (_NEEDED | _OPTIONAL).items():
        if (name in kinds or name in _NEEDED) and kinds.get(name, "-") not in kind:
            raise InputError(f"{path} has {', '.join(sorted(kinds))}; expected {', '.join(_NEEDED)} of TAPVid-3D")
    S, N = arrays["visibility"].shape if arrays["visibility"].ndim == 2 else (0, 0)
    shapes = {
        "images_jpeg_bytes": (S,),
        "tracks_XYZ": (S, N, 3),
        "fx_fy_cx_cy": (4,),
        "extrinsics_w2c": (S, 4, 4),
    }
    for name, shape in shapes.items():
        if name in arrays and (arrays[name].shape != shape or not S * N):
            raise InputError(f"{path} has {name} of shape {arrays[name].shape}; expected {shape}, none of them 0")
    return arrays


def _read(path: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    arrays = _arrays(path)
    chosen = frames.of([f"{frame:05d}" for frame in range(len(arrays["visibility"]))], name)
    taken = [int(frame) for frame in chosen]
    archive = Unpacked()
    pictures = tuple(archive.folder / f"{frame}.jpg" for frame in chosen)
    for picture, frame in zip(pictures, taken, strict=True):
        picture.write_bytes(bytes(arrays["images_jpeg_bytes"][frame]))
    width, height = picture_size(pictures[0])
    fx, fy, cx, cy = arrays["fx_fy_cx_cy"].astype(np.float64)
    matrix = checked_intrinsics(np.array([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]]), path)[0]
    in_camera, visible = arrays["tracks_XYZ"].astype(np.float64), arrays["visibility"] > 0
    visible &= np.isfinite(in_camera).all(axis=2) & (in_camera[..., 2] > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = in_camera[..., :2] / in_camera[..., 2:] * [fx, fy] + [cx, cy]
    visible, notes = seen_inside(places, visible, width, height, path)
    cameras = np.tile(np.eye(3, 4), (len(visible), 1, 1))
    if "extrinsics_w2c" in arrays:
        cameras = arrays["extrinsics_w2c"][:, :3]
    poses = world_from_camera_of(cameras, path)
    points = np.einsum("sij,snj->sni", poses[:, :3, :3], in_camera) + poses[:, None, :3, 3]
    tracks = TrueTracks(points, visible).of_frames(taken)
    return LabelledSequence(
        name,
        pictures,
        world_from_camera=poses[taken],
        intrinsics=np.tile(matrix, (len(taken), 1, 1)),
        notes=(*notes, "it has no depth"),
        frame_names=tuple(chosen),
        archive=archive,
        tracks=tracks,
    )
