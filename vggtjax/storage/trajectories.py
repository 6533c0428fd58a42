"""Camera trajectories as text: timestamp tx ty tz and a quaternion a line, world-from-camera. Does not import jax."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vggtjax.errors import InputError, ResultError

Quaternion = Literal["xyzw", "wxyz"]

_MOST_BYTES = 2**27  # of a text file; a million poses
_UNIT = 0.01  # by which a quaternion's length may differ from 1


def write_trajectory(path: Path, world_from_camera: Float[np.ndarray, "S 4 4"], times: Float[np.ndarray, " S"]) -> None:
    """Write poses in TUM format: timestamp tx ty tz qx qy qz qw, with qw at least 0."""
    poses = world_from_camera.astype(np.float64)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    header = "timestamp tx ty tz qx qy qz qw (world-from-camera)"
    rows = np.column_stack([times, poses[:, :3, 3], quaternions])
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.9g"] * 7, header=header, encoding="utf-8")


def read_trajectory(
    path: str | Path, quaternion: Quaternion = "xyzw"
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S 4 4"]]:
    """Read a trajectory: timestamps, and world-from-camera poses.

    Args:
        path: of a text file with eight numbers a line; lines that start with # are comments.
        quaternion: order of the last four: "xyzw" is TUM's, "wxyz" that of MonST3R, CUT3R, Easi3R and VGGT4D.

    Raises:
        InputError: an order that is neither.
        ResultError: a file that cannot be read, lines without eight finite numbers, or quaternions not of length 1.
    """
    if quaternion not in ("xyzw", "wxyz"):
        raise InputError(f"quaternion is {quaternion!r}; expected 'xyzw' or 'wxyz'")
    rows = read_numbers(path, 8)
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
    """Read a text file of so many finite numbers a line; raises ResultError for anything else."""
    path = Path(path)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ResultError(f"{path} has {path.stat().st_size} bytes; expected at most {_MOST_BYTES}")
        with path.open(encoding="utf-8") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is empty, which is said below
            array = np.loadtxt((line.replace(",", " ") for line in file), ndmin=2)
    except OSError as error:
        raise ResultError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:  # neither text nor numbers, or another number of them
        reason = str(error).split(";")[0].split("\n")[0][:100]
        raise ResultError(f"{path} is not a table of {columns} numbers a line ({reason})") from None
    if array.shape[1] != columns or not len(array):
        found = f"has {array.shape[1]} numbers a line" if len(array) else "is empty"
        raise ResultError(f"{path} {found}; expected {columns} numbers a line")
    if not np.isfinite(array).all():
        raise ResultError(f"{path} holds {array[~np.isfinite(array)][0]}; expected finite numbers")
    return array
