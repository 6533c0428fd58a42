"""7-Scenes. Does not import jax.

7-Scenes: seq-XX/frame-%06d.color.png, .depth.png and .pose.txt. Depth is PNG of 16 bits in millimetres, 65535 and 0
where it is unknown; poses are camera-to-world, 4 x 4, in metres. The page says that colour and depth are not
calibrated, so depth is not at exactly the pixels of the pictures, and gives one camera, KinectFusion's default for
the depth: focal length 585, principal point (320, 240). Its pixel origin is unknown; the centre of the first pixel is
taken to be 0. https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.captures.cameras import (
    intrinsics_matrix,
    with_lost_poses,
)
from vggtjax.clips.captures.depth_files import read_png
from vggtjax.clips.captures.files import files
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import sequence_folders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    left_out,
    map_reader,
    unpictured,
)
from vggtjax.storage.trajectories import read_numbers

_MILLIMETRES = 1000.0
_INVALID = 65535
_CAMERA = (585.0, 585.0, 320.0, 240.0)
_PICTURE, _DEPTH, _POSE = ".color.png", ".depth.png", ".pose.txt"


def seven_scenes(root: Path) -> dict[str, Opener]:
    """Find the sequences of a scene (names such as "seq-01") or of a folder of scenes ("chess/seq-01")."""
    folders = sequence_folders(root, lambda folder: bool(files(folder, _PICTURE)), f"*{_PICTURE}", levels=2)
    return {name: partial(_read_seven_scenes, folder, name) for name, folder in folders.items()}


def _read_seven_scenes(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures, depths, pose_files = (files(folder, ending) for ending in (_PICTURE, _DEPTH, _POSE))
    chosen = frames.of(list(pictures), name)
    taken = [pictures[frame] for frame in chosen]
    read = partial(read_png, per_metre=_MILLIMETRES, invalid=_INVALID)
    depth, gaps, notes = map_reader(
        "depth", taken, [depths.get(frame) for frame in chosen], read, folder / f"*{_DEPTH}"
    )
    gaps += unpictured(frames, pictures, {*depths, *pose_files}, folder / f"*{_PICTURE}")
    nowhere = np.full((4, 4), np.nan)
    poses = np.stack([_pose(pose_files[frame]) if frame in pose_files else nowhere for frame in chosen])
    lost = [frame for frame, pose in zip(chosen, poses, strict=True) if not np.isfinite(pose).all()]
    if len(lost) == len(chosen):
        poses = None
        notes += (f"it has no poses; expected {folder / f'*{_POSE}'}",)
    else:
        gaps += left_out("poses", lost, len(chosen), "have no pose", folder / f"*{_POSE}")
    intrinsics = np.broadcast_to(intrinsics_matrix(*_CAMERA, first_pixel=0, source="7-Scenes"), (len(taken), 3, 3))
    notes += ("depth is not registered to the pictures; the intrinsics are the depth camera's",)
    return LabelledSequence(
        name, tuple(taken), depth, world_from_camera=poses, intrinsics=intrinsics, notes=notes, left_out=gaps
    )


def _pose(path: Path) -> Float64[np.ndarray, "4 4"]:
    rows = read_numbers(path, 4, finite=False)
    if len(rows) != 4:
        raise InputError(f"{path} has {len(rows)} rows; expected a pose of 4 rows")
    return with_lost_poses(rows[None], path)[0]
