"""The TUM RGB-D benchmark and Bonn RGB-D Dynamic, which has the same layout. Does not import jax.

A folder holds rgb.txt and depth.txt, of lines "timestamp path", and groundtruth.txt, of lines "timestamp tx ty tz qx qy
qz qw"; depth is PNG of 16 bits, 5000 to the metre, 0 where it is unknown, at the pixels of the pictures. Both count
pixels from the centre of the first (the benchmark's page lifts whole pixel numbers to points).
TUM: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
Bonn: https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/
"""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int

from vggtjax.clips.sources import natural_key
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.cameras import DISTORTED, intrinsics_matrix
from vggtjax.evaluation.datasets.depth_files import read_png
from vggtjax.evaluation.datasets.folders import inside, read_text, sequence_folders
from vggtjax.evaluation.datasets.frames import FrameChoice
from vggtjax.evaluation.datasets.maps import depth_reader
from vggtjax.evaluation.datasets.sequence import LabelledSequence, Opener
from vggtjax.evaluation.metrics.trajectory import associate
from vggtjax.storage.trajectories import read_numbers, read_trajectory

_PER_METRE = 5000.0
_TOLERANCE = 0.02  # seconds between the timestamps of a picture and of its depth or pose
_CAMERA = re.compile(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)")
# fx fy cx cy of the colour cameras. The pictures of freiburg3 have no distortion.
_FREIBURG = {"1": (517.3, 516.5, 318.6, 255.3), "2": (520.9, 521.0, 325.1, 249.7), "3": (535.4, 539.2, 320.1, 247.6)}
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


class Files(NamedTuple):
    """Files of a list and their times in seconds, in order of time."""

    times: Float64[np.ndarray, " N"]
    paths: list[Path]


def tum(root: Path) -> dict[str, Opener]:
    """Find sequences of the TUM RGB-D benchmark, named without "rgbd_dataset_".

    Frames without a pose are skipped before the stride and the cap, as in MonST3R. Intrinsics are from the file
    calibration.txt (fx fy cx cy), or those of the camera in the folder's name (freiburg1, fr1, ...).
    """
    return {name: partial(_read_tum, folder, name) for name, folder in _folders(root, "rgbd_dataset_").items()}


def bonn(root: Path) -> dict[str, Opener]:
    """Find sequences of Bonn RGB-D Dynamic, named without "rgbd_bonn_".

    The window counts all pictures, as in MonST3R's evaluation of depth. Poses are missing unless every frame has one.
    """
    return {name: partial(_read_bonn, folder, name) for name, folder in _folders(root, "rgbd_bonn_").items()}


def partners(first: Float[np.ndarray, " N"], second: Float[np.ndarray, " M"]) -> Int[np.ndarray, " N"]:
    """Return for each time of `first` the index of its partner in `second` by the benchmark's rule, or -1."""
    indices = np.full(len(first), -1)
    pairs = associate(first, second, _TOLERANCE)
    indices[pairs[:, 0]] = pairs[:, 1]
    return indices


def _folders(root: Path, prefix: str) -> dict[str, Path]:
    folders = sequence_folders(
        root, lambda folder: (folder / "rgb.txt").is_file(), "rgb.txt, depth.txt, groundtruth.txt"
    )
    return {name.removeprefix(prefix): folder for name, folder in folders.items()}


def _read_tum(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures = _listed(folder, "rgb.txt")
    poses, posed = _poses(folder, pictures.times)
    notes: tuple[str, ...] = ()
    candidates = np.arange(len(pictures.paths))
    if poses is None or (posed < 0).all():
        notes += ("it has no groundtruth.txt" if poses is None else f"no frame has a pose within {_TOLERANCE} s",)
        poses = None
    elif (lost := np.flatnonzero(posed < 0)).size:
        candidates = np.flatnonzero(posed >= 0)
        notes += (
            f"{len(lost)} of {len(posed)} frames have no pose within {_TOLERANCE} s and are skipped, "
            f"{pictures.paths[lost[0]].stem} first",
        )
    chosen = frames.of(candidates.tolist(), name)
    notes += frames.shortage(len(candidates))
    intrinsics, more = _tum_intrinsics(folder)
    return _sequence(
        folder, name, pictures, chosen, None if poses is None else poses[posed[chosen]], intrinsics, notes + more
    )


def _read_bonn(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures = _listed(folder, "rgb.txt")
    chosen = frames.of(range(len(pictures.paths)), name)
    notes = (*frames.shortage(len(pictures.paths)), DISTORTED)
    poses, posed = _poses(folder, pictures.times)
    if poses is None:
        notes += ("it has no groundtruth.txt",)
    elif lost := [frame for frame in chosen if posed[frame] < 0]:
        first = pictures.paths[lost[0]].stem
        notes += (f"{len(lost)} of {len(chosen)} frames have no pose within {_TOLERANCE} s, {first} first; no poses",)
        poses = None
    if poses is not None:
        left, _, right = np.linalg.svd(_MARKERS[:3, :3])
        markers = _MARKERS.copy()
        markers[:3, :3] = left @ right
        poses = _ROS @ poses[posed[chosen]] @ _ROS @ markers
        notes += ("poses are of the markers, moved to the camera by the data set's calibration",)
    intrinsics = intrinsics_matrix(*_BONN, first_pixel=0, source="Bonn")
    return _sequence(folder, name, pictures, chosen, poses, intrinsics, notes)


def _sequence(
    folder: Path,
    name: str,
    pictures: Files,
    chosen: list[int],
    poses: Float64[np.ndarray, "S 4 4"] | None,
    intrinsics: Float64[np.ndarray, "3 3"] | None,
    notes: tuple[str, ...],
) -> LabelledSequence:
    taken = [pictures.paths[frame] for frame in chosen]
    maps: list[Path | None] = [None] * len(taken)
    if (folder / "depth.txt").is_file():
        depths = _listed(folder, "depth.txt")
        # Partners are sought among all pictures, so that a choice of frames does not change the owner of a depth map.
        owners = partners(pictures.times, depths.times)[chosen]
        maps = [depths.paths[owner] if owner >= 0 else None for owner in owners]
    for path in (*taken, *(path for path in maps if path is not None)):
        if not path.is_file():
            raise InputError(f"{path} is missing, but rgb.txt or depth.txt names it; get the sequence whole")
    depth, more = depth_reader(taken, maps, partial(read_png, per_metre=_PER_METRE))
    return LabelledSequence(
        name,
        tuple(taken),
        depth,
        world_from_camera=poses,
        intrinsics=None if intrinsics is None else np.broadcast_to(intrinsics, (len(taken), 3, 3)),
        timestamps=pictures.times[chosen],
        notes=notes + more,
    )


def _listed(folder: Path, name: str) -> Files:
    path = folder / name
    entries = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            time, valid = float(words[0]), len(words) == 2
        except ValueError:
            time, valid = 0.0, False
        if not valid or not math.isfinite(time):
            raise InputError(f"{path} has {line[:80]!r} in line {number}; expected a timestamp and a path")
        entries.append((time, inside(folder, words[1], path)))
    if not entries:
        raise InputError(f"{path} names no files; expected lines of a timestamp and a path")
    entries.sort(key=lambda entry: (entry[0], natural_key(entry[1])))
    return Files(np.array([time for time, _ in entries]), [file for _, file in entries])


def _poses(
    folder: Path, times: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "M 4 4"] | None, Int[np.ndarray, " N"]]:
    path = folder / "groundtruth.txt"
    if not path.is_file():
        return None, np.full(len(times), -1)
    stamps, poses = read_trajectory(path)
    return np.asarray(poses, np.float64), partners(times, stamps)


def _tum_intrinsics(folder: Path) -> tuple[Float64[np.ndarray, "3 3"] | None, tuple[str, ...]]:
    path = folder / "calibration.txt"
    if path.is_file():
        rows = read_numbers(path, 4)
        if len(rows) != 1:
            raise InputError(f"{path} has {len(rows)} rows; expected one: fx fy cx cy")
        fx, fy, cx, cy = rows[0].tolist()
        return intrinsics_matrix(fx, fy, cx, cy, first_pixel=0, source=path), ()
    if not (match := _CAMERA.search(folder.resolve().name.lower())):
        return None, ("its camera is unknown; name the folder after the camera, or put fx fy cx cy in calibration.txt",)
    matrix = intrinsics_matrix(*_FREIBURG[match[1]], first_pixel=0, source=f"freiburg{match[1]}")
    return matrix, () if match[1] == "3" else (DISTORTED,)
