"""Camera trajectories as text: timestamp tx ty tz and a quaternion per line, world-from-camera. Does not import jax."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vggtjax.errors import ResultError, check_choice, reading

Quaternion = Literal["xyzw", "wxyz"]

_MOST_BYTES = 2**27  # of a text file; a million poses
_UNIT = 0.01  # by which a quaternion's length may differ from 1
_COLUMNS = {"xyzw": "qx qy qz qw", "wxyz": "qw qx qy qz"}


def write_trajectory(
    path: Path,
    world_from_camera: Float[np.ndarray, "S 4 4"],
    times: Float[np.ndarray, " S"],
    *,
    quaternion: Quaternion = "xyzw",
    note: str = "",
) -> None:
    """Write poses as timestamp tx ty tz and a quaternion with w at least 0.

    Files in TUM's order "xyzw" start with a comment of the columns and the `note`; files in the order "wxyz" of MonST3R
    and VGGT4D have no comments, as theirs.
    """
    poses = world_from_camera.astype(np.float64)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True, scalar_first=quaternion == "wxyz")
    rows = np.column_stack([times, poses[:, :3, 3], turns])
    header = commented(f"timestamp tx ty tz {_COLUMNS['xyzw']} (world-from-camera)", note)
    header = header if quaternion == "xyzw" else ""
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.9g"] * 7, header=header, comments="", encoding="utf-8")


def commented(columns: str, note: str) -> str:
    """Return the header of a text file: a comment of its columns and, unless empty, one of the note."""
    return "\n".join(f"# {line}" for line in (columns, note) if line)


def read_trajectory(
    path: str | Path, quaternion: Quaternion = "xyzw"
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S 4 4"]]:
    """Read a trajectory: timestamps, and world-from-camera poses.

    Each line has eight numbers; text after # is a comment. `quaternion` is the order of the last four: "xyzw" is TUM's,
    "wxyz" that of MonST3R, CUT3R, Easi3R and VGGT4D. Raises InputError for an unknown order, and ResultError for an
    unreadable file, a first line that names the other order, lines without eight finite numbers, or quaternions not of
    length 1.
    """
    check_choice("quaternion", quaternion, get_args(Quaternion))
    rows = read_numbers(path, 8)
    other: Quaternion = "wxyz" if quaternion == "xyzw" else "xyzw"
    with Path(path).open(encoding="utf-8") as file:
        if _COLUMNS[other] in file.readline(1000):
            raise ResultError(f"{path} names its columns {_COLUMNS[other]}; read it with quaternion={other!r}")
    turns = rows[:, 4:] if quaternion == "xyzw" else rows[:, [5, 6, 7, 4]]
    lengths = np.linalg.norm(turns, axis=1)
    if (abs(lengths - 1) > _UNIT).any():
        line = int(np.argmax(abs(lengths - 1)))
        raise ResultError(f"{path} has a quaternion of length {lengths[line]:.3f} in pose {line}; expected 1")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(turns).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def read_numbers(path: str | Path, columns: int) -> Float[np.ndarray, "S columns"]:
    """Read a text file of `columns` finite numbers per line. Raises ResultError for anything else."""
    path = Path(path)
    with reading(path, ResultError), path.open(encoding="utf-8") as file, warnings.catch_warnings():
        if path.stat().st_size > _MOST_BYTES:
            raise ResultError(f"{path} has {path.stat().st_size} bytes; expected at most {_MOST_BYTES}")
        warnings.simplefilter("ignore")  # of an empty file, an error below
        try:
            array = np.loadtxt((line.replace(",", " ") for line in file), ndmin=2)
        except ValueError as error:  # not text, not numbers, or lines of different length
            reason = str(error).split(";")[0].split("\n")[0][:100]
            raise ResultError(f"{path} is not a table of {columns} numbers a line ({reason})") from None
    if array.shape[1] != columns or not len(array):
        problem = f"has {array.shape[1]} numbers a line" if len(array) else "is empty"
        raise ResultError(f"{path} {problem}; expected {columns} numbers a line")
    if not np.isfinite(array).all():
        raise ResultError(f"{path} holds {array[~np.isfinite(array)][0]}; expected finite numbers")
    return array
