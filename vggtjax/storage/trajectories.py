"""Camera trajectories as text: timestamp tx ty tz and a quaternion per line, world-from-camera. Does not import jax."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, TextIO, get_args

import numpy as np
import scipy
from jaxtyping import Float, Float64, Int

from vggtjax.errors import InputError, ResultError, check_choice, reading

Quaternion = Literal["xyzw", "wxyz"]

_MOST_BYTES = 2**27  # of a text file; a million poses
_NAME = re.compile(r"(?!(?:nan|inf|infinity)$)[^\W\d][\w.]*|\[\S*\]", re.IGNORECASE)  # of a column, or its unit
_FEWEST_NAMES = 3
_TURN_NAME = re.compile(r"\b(?:q|quat|quaternion|orientation|rot)(?:_\w+)?[._]?([wxyz])\b")
_LONGEST_LINE = 2**16  # letters
_MOST_HEADER = 50  # lines of comments in front
_UNIT = 0.01  # by which a quaternion's length may differ from 1
_WIDER = 1.01  # times the tolerance is the search range for partners: sums of times are rounded
_MOST_CANDIDATES = 10_000_000  # pairs of timestamps within the tolerance; 160 MB of indices
_COLUMNS: dict[Quaternion, str] = {"xyzw": "qx qy qz qw", "wxyz": "qw qx qy qz"}


def write_trajectory(
    path: Path,
    world_from_camera: Float[np.ndarray, "S 4 4"],
    times: Float[np.ndarray, " S"] | Sequence[str],
    *,
    quaternion: Quaternion = "xyzw",
    note: str = "",
) -> None:
    """Write poses as timestamp tx ty tz and a quaternion with w at least 0; times are seconds, or texts of them.

    Files in TUM's order "xyzw" start with a comment of the columns and the `note`; files in the order "wxyz" of MonST3R
    and VGGT4D have no comments, as theirs.
    """
    poses = world_from_camera.astype(np.float64)
    turns = scipy.spatial.transform.Rotation.from_matrix(poses[:, :3, :3]).as_quat(
        canonical=True, scalar_first=quaternion == "wxyz"
    )
    texts = [time if isinstance(time, str) else f"{time:.6f}" for time in times]
    rows = np.column_stack([poses[:, :3, 3], turns])
    header = commented(f"timestamp tx ty tz {_COLUMNS['xyzw']} (world-from-camera)", note)
    header = header if quaternion == "xyzw" else ""
    lines = [" ".join([text, *(f"{value:.9g}" for value in row)]) for text, row in zip(texts, rows, strict=True)]
    path.write_text("\n".join([*header.splitlines(), *lines]) + "\n", encoding="utf-8", newline="\n")


def commented(columns: str, note: str) -> str:
    """Return the header of a text file: a comment of its columns and, unless empty, one of the note."""
    return "\n".join(f"# {line}" for line in (columns, note) if line)


def read_trajectory(
    path: str | Path, quaternion: Quaternion | None = None, *, lost: bool = False
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S 4 4"]]:
    """Read a trajectory: timestamps, and world-from-camera poses.

    Each line has eight numbers; text after # is a comment, and the first line may name the columns. `quaternion` is the
    order of the last four: "xyzw" is TUM's, "wxyz" that of MonST3R, CUT3R, Easi3R and VGGT4D; without it the names of
    the columns tell, and where there are none it is TUM's. Raises InputError for an unknown order, and ResultError for
    an unreadable file, names of columns in the other order, lines without eight finite numbers, or quaternions not of
    length 1. With `lost`, a pose that is not finite, or whose quaternion is 0, is one of NaN.
    """
    if quaternion is not None:
        check_choice("quaternion", quaternion, get_args(Quaternion))
    rows, named = read_numbers(path, 8, finite=not lost), named_order(path)
    if named is not None and quaternion is not None and named != quaternion:
        raise ResultError(f"{path} names its columns {_COLUMNS[named]}; read it with quaternion={named!r}")
    is_first = (quaternion or named) == "wxyz"
    turns = rows[:, [5, 6, 7, 4]] if is_first else rows[:, 4:]
    found = np.isfinite(rows).all(axis=1) & rows[:, 4:].any(axis=1) if lost else np.ones(len(rows), bool)
    poses = np.full((len(rows), 4, 4), np.nan)
    poses[found] = pose_matrices(rows[found, 1:4], turns[found], path)
    return rows[:, 0], poses


def named_order(path: str | Path) -> Quaternion | None:
    """Return the order of the quaternions that the first lines of a text file name, None where they name none.

    Names are such as qw, q_w or q_RS_w [], in any case. Raises ResultError for other orders than the two.
    """
    with reading(path, ResultError), Path(path).open(encoding="utf-8-sig", errors="replace") as file:
        for _ in range(_MOST_HEADER):
            line = file.readline(1000)
            letters = "".join(_TURN_NAME.findall(line.lower()))
            if letters in ("xyzw", "wxyz"):
                return letters
            if sorted(letters) == sorted("wxyz"):
                raise ResultError(f"{path} names its columns q{' q'.join(letters)}; expected qw first or last of them")
            if not line or (line.strip() and not line.lstrip().startswith("#")):
                break
    return None


def pose_matrices(
    places: Float[np.ndarray, "S 3"], turns: Float[np.ndarray, "S 4"], source: str | Path
) -> Float64[np.ndarray, "S 4 4"]:
    """Return the matrices of translations and quaternions x y z w.

    Raises ResultError, which names `source`, for a quaternion not of length 1.
    """
    lengths = np.linalg.norm(turns, axis=1)
    if (abs(lengths - 1) > _UNIT).any():
        line = int(np.argmax(abs(lengths - 1)))
        raise ResultError(f"{source} has a quaternion of length {lengths[line]:.3f} in pose {line}; expected 1")
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3] = scipy.spatial.transform.Rotation.from_quat(turns).as_matrix()
    poses[:, :3, 3] = places
    return poses


def associate(
    times: Float[np.ndarray, " N"], other_times: Float[np.ndarray, " M"], tolerance: float = 0.02
) -> Int[np.ndarray, "K 2"]:
    """Return pairs of timestamps, as TUM's tools for RGB-D sequences pair them.

    Of all pairs less than `tolerance` apart the closest comes first, then the closest pair of unpaired timestamps, and
    so on.

    Args:
        times: seconds, in any order.
        other_times: seconds, in any order.
        tolerance: seconds; a pair exactly as far apart does not count.

    Returns:
        Indices into `times` and `other_times`, in the order of `times`; empty if no pair is close enough.

    Raises:
        InputError: times that are not finite or not one-dimensional, a tolerance that is not above 0, or more than ten
            million pairs within the tolerance.
    """
    first, second = (_timestamps(name, values) for name, values in (("times", times), ("other_times", other_times)))
    if not tolerance > 0:
        raise InputError(f"tolerance is {tolerance}; expected seconds above 0")
    order = np.argsort(second, kind="stable")
    starts = np.searchsorted(second[order], first - _WIDER * tolerance, side="left")
    counts = np.searchsorted(second[order], first + _WIDER * tolerance, side="right") - starts
    if counts.sum() > _MOST_CANDIDATES:
        raise InputError(f"{counts.sum()} pairs of times are within {tolerance} s; expected a smaller tolerance")
    left = np.repeat(np.arange(len(first)), counts)
    offsets = np.arange(len(left)) - np.repeat(counts.cumsum() - counts, counts)
    right = order[np.repeat(starts, counts) + offsets]
    apart = np.abs(first[left] - second[right])
    near = np.flatnonzero(apart < tolerance)
    near = near[np.lexsort((second[right[near]], first[left[near]], apart[near]))]
    partner = np.full(len(first), -1)
    taken = np.zeros(len(second), bool)
    for i, j in zip(left[near].tolist(), right[near].tolist(), strict=True):
        if partner[i] < 0 and not taken[j]:
            partner[i], taken[j] = j, True
    paired = np.flatnonzero(partner >= 0)
    paired = paired[np.argsort(first[paired], kind="stable")]
    return np.stack([paired, partner[paired]], axis=1)


def _timestamps(name: str, times) -> Float64[np.ndarray, " N"]:
    times = np.asarray(times, np.float64)
    if times.ndim != 1 or not np.isfinite(times).all():
        raise InputError(f"{name} has shape {times.shape}; expected finite seconds [N]")
    return times


def read_numbers(
    path: str | Path, columns: int | tuple[int, ...], *, finite: bool = True
) -> Float[np.ndarray, "S columns"]:
    """Read a text file of `finite` numbers, `columns` in every line, or one of several numbers of columns.

    Text after # is a comment, commas count as spaces, and a first line of words names the columns. Raises ResultError
    for anything else.
    """
    path = Path(path)
    choices = (columns,) if isinstance(columns, int) else columns
    expected = " or ".join(map(str, choices))
    with reading(path, ResultError), path.open(encoding="utf-8-sig") as file, warnings.catch_warnings():
        if path.stat().st_size > _MOST_BYTES:
            raise ResultError(f"{path} has {path.stat().st_size} bytes; expected at most {_MOST_BYTES}")
        warnings.simplefilter("ignore")  # of an empty file, an error below
        try:
            array = np.loadtxt(_lines(file, path), ndmin=2)
        except ResultError:
            raise
        except ValueError as error:  # not text, not numbers, or lines of different length
            reason = str(error).split(";")[0].split("\n")[0][:100]
            raise ResultError(f"{path} is not a table of {expected} numbers a line ({reason})") from None
    if array.shape[1] not in choices or not len(array):
        problem = f"has {array.shape[1]} numbers a line" if len(array) else "is empty"
        raise ResultError(f"{path} {problem}; expected {expected} numbers a line")
    if finite and not np.isfinite(array).all():
        raise ResultError(f"{path} holds {array[~np.isfinite(array)][0]}; expected finite numbers")
    return array


def _lines(file: TextIO, path: Path) -> Iterator[str]:
    """Yield lines with spaces for commas, without names of columns; one long line would take many times its size."""
    names_may_come = True
    while line := file.readline(_LONGEST_LINE + 1):
        if len(line) > _LONGEST_LINE:
            raise ResultError(f"{path} has a line of over {_LONGEST_LINE} letters; expected numbers")
        words = line.partition("#")[0].replace(",", " ").split()
        is_named = names_may_come and len(words) >= _FEWEST_NAMES and all(map(_NAME.fullmatch, words))
        names_may_come = names_may_come and not words
        yield "" if is_named else line.replace(",", " ")
