"""7-Scenes: seq-XX/frame-%06d.color.png, .depth.png and .pose.txt. Does not import jax.

Depth is PNG of 16 bits in millimetres, 65535 and 0 where it is unknown; poses are camera-to-world, 4 x 4, in metres.
The page says that colour and depth are not calibrated, so depth is not at exactly the pixels of the pictures, and gives
one camera, KinectFusion's default for the depth: focal length 585, principal point (320, 240). Its pixel origin is
unknown; the centre of the first pixel is taken to be 0.
https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.captures.cameras import checked_world_from_camera, intrinsics_matrix
from vggtjax.captures.depth_files import read_png
from vggtjax.captures.files import files
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.folders import sequence_folders
from vggtjax.evaluation.datasets.frames import FrameChoice
from vggtjax.evaluation.datasets.maps import depth_reader
from vggtjax.evaluation.datasets.sequence import LabelledSequence, Opener
from vggtjax.storage.trajectories import read_numbers

_PER_METRE = 1000.0
_INVALID = 65535
_CAMERA = (585.0, 585.0, 320.0, 240.0)
_PICTURE, _DEPTH, _POSE = ".color.png", ".depth.png", ".pose.txt"


def seven_scenes(root: Path) -> dict[str, Opener]:
    """Find the sequences of a scene (names such as "seq-01") or of a folder of scenes ("chess/seq-01")."""
    folders = sequence_folders(root, lambda folder: bool(files(folder, _PICTURE)), f"frames *{_PICTURE}", levels=2)
    return {name: partial(_read, folder, name) for name, folder in folders.items()}


def _read(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures, depths, pose_files = (files(folder, ending) for ending in (_PICTURE, _DEPTH, _POSE))
    chosen = frames.of(list(pictures), name)
    taken = [pictures[frame] for frame in chosen]
    read = partial(read_png, per_metre=_PER_METRE, invalid=_INVALID)
    depth, notes = depth_reader(taken, [depths.get(frame) for frame in chosen], read)
    poses = None
    if missing := [frame for frame in chosen if frame not in pose_files]:
        notes += (f"{len(missing)} of {len(chosen)} frames have no pose, {missing[0]} first; no poses",)
    else:
        poses = np.stack([_pose(pose_files[frame]) for frame in chosen])
    intrinsics = np.broadcast_to(intrinsics_matrix(*_CAMERA, first_pixel=0, source="7-Scenes"), (len(taken), 3, 3))
    notes += ("depth is not registered to the pictures; the intrinsics are the depth camera's",)
    return LabelledSequence(name, tuple(taken), depth, world_from_camera=poses, intrinsics=intrinsics, notes=notes)


def _pose(path: Path) -> Float64[np.ndarray, "4 4"]:
    rows = read_numbers(path, 4)
    if len(rows) != 4:
        raise InputError(f"{path} has {len(rows)} rows; expected a pose of 4 rows")
    return checked_world_from_camera(rows[None], path)[0]
