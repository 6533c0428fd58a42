"""The cameras of VGGT4D's and MonST3R's text files, and which frames they are of. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from vggtjax.cameras import Cameras, world_from_camera
from vggtjax.errors import ResultError
from vggtjax.storage.trajectories import Quaternion, read_numbers, read_trajectory

_MOST_NUMBER = 10**9  # of a frame


class Posed(NamedTuple):
    """Numbers of frames, their cameras, their times where they are known in seconds, and the numbers of their files.

    `every` are the numbers of all frames of which the folder has anything.
    """

    numbers: Sequence[int]
    cameras: Cameras
    times: Float64[np.ndarray, " S"] | None
    files: Sequence[int]
    every: Sequence[int]


def text_cameras(folder: Path, files: Sequence[int], quaternion: Quaternion | None) -> Posed:
    """Return the cameras of the frames whose files have these numbers.

    Times that are whole numbers are numbers of frames, unless both lists count on from 0. Where there are more poses
    than maps, or fewer, those numbers tell which frames have both.
    """
    times, poses = read_trajectory(folder / "pred_traj.txt", quaternion, lost=True)
    intrinsics = read_numbers(folder / "pred_intrinsics.txt", 9).reshape(-1, 3, 3)
    counted = list(range(len(times)))
    is_timed = bool(np.isfinite(times).all() and (np.diff(times) > 0).all())
    is_whole = is_timed and bool((times == np.round(times)).all()) and times[0] >= 0 and times[-1] < _MOST_NUMBER
    whole = times.astype(int).tolist() if is_whole else counted
    lines = {number: line for line, number in enumerate(whole)}
    kept = list(files)
    if len(poses) != len(files):
        told = is_whole and (len(poses) > len(files) or whole != counted)
        kept = [number for number in files if number in lines] if told else []
    for name, array in (("pred_traj.txt", poses), ("pred_intrinsics.txt", intrinsics)):
        if not kept or len(array) not in (len(poses), len(files)):
            raise ResultError(f"{name} has {len(array)} lines for {len(files)} frames of depth; expected one for each")
    rows = list(range(len(files))) if len(poses) == len(files) else [lines[number] for number in kept]
    order = {number: place for place, number in enumerate(files)}
    places = rows if len(intrinsics) == len(poses) else [order[number] for number in kept]
    inverse = np.full((len(rows), 4, 4), np.nan)
    found = np.isfinite(poses[rows]).all(axis=(1, 2))
    inverse[found] = world_from_camera(poses[rows][found][:, :3])
    numbers = whole if len(poses) == len(files) and list(files) == counted else kept
    every = numbers if len(poses) == len(files) else sorted({*files, *whole})
    timed = None if is_whole or not is_timed else times[rows]
    return Posed(numbers, Cameras(inverse[:, :3], intrinsics[places]), timed, kept, every)
