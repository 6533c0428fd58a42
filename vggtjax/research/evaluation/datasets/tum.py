"""The TUM RGB-D benchmark and Bonn RGB-D Dynamic, which has the same layout. Does not import jax.

`vggtjax.clips.captures.tum` reads the files. https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.captures.cameras import DISTORTED, intrinsics_matrix
from vggtjax.clips.captures.depth_files import read_png
from vggtjax.clips.captures.tum import (
    NO_POSES,
    PER_METRE,
    TOLERANCE,
    Files,
    depth_files,
    read_intrinsics,
    read_list,
    read_poses,
)
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import sequence_folders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    LeftOut,
    Opener,
    left_out,
    map_reader,
)

_BONN = (542.822841, 542.576870, 315.593520, 237.756098)
# Bonn tracks markers on the camera. Its page takes a point of the camera to the world by ROS T ROS MARKERS, with T from
# groundtruth.txt. The 3 x 3 part of MARKERS is a rotation times 1.059; the poses take the rotation alone.
_ROS = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
_MARKERS = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)


def tum(root: Path) -> dict[str, Opener]:
    """Find sequences of the TUM RGB-D benchmark, named without "rgbd_dataset_".

    Frames without a pose are skipped before the stride and the cap, as in MonST3R. Intrinsics are from the file
    calibration.txt (fx fy cx cy), or those of the camera in the folder's name (freiburg1, fr1, ...).
    """
    return {name: partial(_read_tum, folder, name) for name, folder in _folders(root, "rgbd_dataset_").items()}


def bonn(root: Path) -> dict[str, Opener]:
    """Find sequences of Bonn RGB-D Dynamic, named without "rgbd_bonn_".

    The window counts all pictures, as in MonST3R's evaluation of depth.
    """
    return {name: partial(_read_bonn, folder, name) for name, folder in _folders(root, "rgbd_bonn_").items()}


def _folders(root: Path, prefix: str) -> dict[str, Path]:
    folders = sequence_folders(root, lambda folder: (folder / "rgb.txt").is_file(), "rgb.txt")
    return {name.removeprefix(prefix): folder for name, folder in folders.items()}


def _read_tum(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures = read_list(folder, "rgb.txt")
    poses, posed = read_poses(folder, pictures.times)
    notes: tuple[str, ...] = ()
    skipped: tuple[LeftOut, ...] = ()
    candidates = np.arange(len(pictures.paths))
    if poses is None or (posed < 0).all():
        notes += (_no_poses(folder) if poses is None else f"no frame has a pose within {TOLERANCE} s",)
        poses = None
    elif (lost := np.flatnonzero(posed < 0)).size:
        candidates = np.flatnonzero(posed >= 0)
        names = [pictures.paths[frame].stem for frame in lost]
        skipped = left_out("poses", names, len(posed), f"have no pose within {TOLERANCE} s and are skipped", usual=True)
    chosen = frames.of(candidates.tolist(), name, [pictures.paths[frame] for frame in candidates])
    notes += frames.shortage(len(candidates))
    intrinsics, more = read_intrinsics(folder)
    poses = None if poses is None else poses[posed[chosen]]
    return _sequence(folder, name, pictures, chosen, poses, intrinsics, notes + more, skipped)


def _read_bonn(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures = read_list(folder, "rgb.txt")
    chosen = frames.of(range(len(pictures.paths)), name, pictures.paths)
    notes = (*frames.shortage(len(pictures.paths)), DISTORTED)
    poses, posed = read_poses(folder, pictures.times)
    if poses is None:
        notes += (_no_poses(folder),)
    lost: list[str] = []
    if poses is not None:
        lost = [pictures.paths[frame].stem for frame in chosen if posed[frame] < 0]
        left, _, right = np.linalg.svd(_MARKERS[:3, :3])
        markers = _MARKERS.copy()
        markers[:3, :3] = left @ right
        poses = _ROS @ poses[posed[chosen]] @ _ROS @ markers
        poses[posed[chosen] < 0] = np.nan
        notes += ("poses are of the markers, moved to the camera by the data set's calibration",)
    intrinsics = intrinsics_matrix(*_BONN, first_pixel=0, source="Bonn")
    missing = left_out("poses", lost, len(chosen), f"have no pose within {TOLERANCE} s")
    return _sequence(folder, name, pictures, chosen, poses, intrinsics, notes, missing)


def _no_poses(folder: Path) -> str:
    return f"{NO_POSES}; expected {folder / 'groundtruth.txt'}"


def _sequence(
    folder: Path,
    name: str,
    pictures: Files,
    chosen: list[int],
    poses: Float64[np.ndarray, "S 4 4"] | None,
    intrinsics: Float64[np.ndarray, "3 3"] | None,
    notes: tuple[str, ...],
    missing: tuple[LeftOut, ...],
) -> LabelledSequence:
    there = [place for place, frame in enumerate(chosen) if pictures.paths[frame].is_file()]
    if not there:
        raise InputError(f"{pictures.paths[chosen[0]]} is missing, and so is every picture that rgb.txt names")
    absent = [pictures.paths[frame].stem for frame in chosen if not pictures.paths[frame].is_file()]
    missing += left_out("pictures", absent, len(chosen), "have no picture, but rgb.txt names it")
    poses = None if poses is None else poses[there]
    chosen = [chosen[place] for place in there]
    taken = [pictures.paths[frame] for frame in chosen]
    maps = depth_files(folder, pictures.times, chosen, whole=False) or (None,) * len(taken)
    depth, gaps, more = map_reader("depth", taken, maps, partial(read_png, per_metre=PER_METRE), folder / "depth.txt")
    return LabelledSequence(
        name,
        tuple(taken),
        depth,
        world_from_camera=poses,
        intrinsics=None if intrinsics is None else np.broadcast_to(intrinsics, (len(taken), 3, 3)),
        timestamps=pictures.times[chosen],
        notes=notes + more,
        left_out=missing + gaps,
    )
