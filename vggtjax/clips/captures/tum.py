"""Folders of the TUM RGB-D benchmark: lists of files, poses and intrinsics. Does not import jax.

A folder holds rgb.txt and depth.txt, of lines "timestamp path", and groundtruth.txt, of lines "timestamp tx ty tz qx qy
qz qw"; depth is PNG of 16 bits, 5000 to the metre, 0 where it is unknown, at the pixels of the pictures. Both count
pixels from the centre of the first (the benchmark's page lifts whole pixel numbers to points). calibration.txt is ours:
fx fy cx cy. https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int

from vggtjax.clips.captures.cameras import DISTORTED, intrinsics_matrix
from vggtjax.clips.captures.capture import Capture, checked_sizes, left_out, there
from vggtjax.clips.captures.depth_files import read_png
from vggtjax.clips.captures.files import inside, read_text
from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError
from vggtjax.storage.trajectories import associate, read_numbers, read_trajectory

PER_METRE = 5000.0
NO_POSES = "it has no groundtruth.txt"  # a note
TOLERANCE = 0.02  # seconds between the timestamps of a picture and of its depth or pose
_CAMERA = re.compile(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)")
# fx fy cx cy of the colour cameras. The pictures of freiburg3 have no distortion.
_FREIBURG = {"1": (517.3, 516.5, 318.6, 255.3), "2": (520.9, 521.0, 325.1, 249.7), "3": (535.4, 539.2, 320.1, 247.6)}


class Files(NamedTuple):
    """Files of a list and their times in seconds, in order of time."""

    times: Float64[np.ndarray, " N"]
    paths: list[Path]


def partners(first: Float[np.ndarray, " N"], second: Float[np.ndarray, " M"]) -> Int[np.ndarray, " N"]:
    """Return for each time of `first` the index of its partner in `second` by the benchmark's rule, or -1."""
    indices = np.full(len(first), -1)
    pairs = associate(first, second, TOLERANCE)
    indices[pairs[:, 0]] = pairs[:, 1]
    return indices


def read_list(folder: Path, name: str) -> Files:
    """Return the files of a list such as rgb.txt; raises InputError for other lines, and paths out of the folder."""
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
    entries = sorted(in_order(entries, lambda entry: entry[1]), key=lambda entry: entry[0])
    return Files(np.array([time for time, _ in entries]), [file for _, file in entries])


def read_poses(
    folder: Path, times: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "M 4 4"] | None, Int[np.ndarray, " N"]]:
    """Return the poses of groundtruth.txt, if there is one, and for each time the index of its pose, or -1."""
    path = folder / "groundtruth.txt"
    if not path.is_file():
        return None, np.full(len(times), -1)
    stamps, poses = read_trajectory(path, lost=True)
    found = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(stamps)
    return np.asarray(poses[found], np.float64), partners(times, stamps[found])


def read_intrinsics(folder: Path) -> tuple[Float64[np.ndarray, "3 3"] | None, tuple[str, ...]]:
    """Return the intrinsics of calibration.txt or of the camera in the folder's name, or None, and notes."""
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


def read_tum(folder: Path, *, whole: bool = True) -> Capture:
    """Read a folder of the benchmark; frames without a pose are left out."""
    listed = read_list(folder, "rgb.txt")
    count = len(listed.paths)
    poses, posed = read_poses(folder, listed.times)
    frames = np.arange(count) if poses is None else np.flatnonzero(posed >= 0)
    if not len(frames):
        raise InputError(f"no picture of {folder} has a pose within {TOLERANCE} s; expected groundtruth.txt to fit")
    lost = [listed.paths[frame].stem for frame in np.setdiff1d(np.arange(count), frames)]
    missing = left_out(lost, count, f"pose within {TOLERANCE} s")
    notes = missing + (NO_POSES,) * (poses is None)
    kept, absent = there([listed.paths[frame] for frame in frames], folder / "rgb.txt", whole=whole)
    frames = frames[kept]
    pictures = tuple(listed.paths[frame] for frame in frames)
    sizes = checked_sizes(pictures, folder / "rgb.txt")
    intrinsics, more = read_intrinsics(folder)
    return Capture(
        "tum",
        folder,
        pictures,
        sizes,
        None if intrinsics is None else np.tile(intrinsics, (len(pictures), 1, 1)),
        None if poses is None else poses[posed[frames]],
        has_unknown_lens=DISTORTED in more,
        metric=True,
        depth_files=depth_files(folder, listed.times, frames, whole=whole),
        read_depth_file=partial(read_png, per_metre=PER_METRE),
        timestamps=listed.times[frames],
        absent=absent,
        left_out=missing,
        notes=notes + more,
    )


def depth_files(
    folder: Path, times: Float64[np.ndarray, " N"], frames: Sequence[int] | Int[np.ndarray, " S"], *, whole: bool = True
) -> tuple[Path | None, ...] | None:
    """Return the depth maps of some pictures of the list with these times; None where there is no depth.txt.

    Partners are sought among all pictures, so that a choice of frames does not change the owner of a depth map.
    Raises InputError for a file that is listed and missing; unless `whole`, its frame has no depth.
    """
    if not (folder / "depth.txt").is_file():
        return None
    listed = read_list(folder, "depth.txt")
    owners = partners(times, listed.times)[frames]
    found = tuple(listed.paths[owner] if owner >= 0 else None for owner in owners)
    missing = dict.fromkeys(path for path in found if path is not None and not path.is_file())
    if missing and whole:
        raise InputError(f"{next(iter(missing))} is missing, but depth.txt names it; get the capture whole")
    return tuple(None if path in missing else path for path in found)
