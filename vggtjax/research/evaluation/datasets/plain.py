"""Plain folders: rgb/, and optionally depth/, mask/, K.txt and world_from_camera.txt. Does not import jax.

Clips of `vggtjax scenes` are read too: images/, intrinsics.txt and trajectory.txt stand for the first and the last two.

Depth is PNG of 16 bits in millimetres, .npy in metres (of whole numbers: in millimetres) or .exr in metres, 0 where it
is unknown; masks are pictures of any kind, bright where the world moves. K.txt has three rows of three numbers for all
frames, or three rows for each; world_from_camera.txt a row of 16 numbers for each frame, or of 12 as KITTI's, in
metres; numbers of a frame without a pose are not finite. Intrinsics are not shifted by half a pixel: the pixel origin
of the HoloLens is unknown, and half a pixel is below the accuracy of its poses and depth.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import checked_intrinsics, with_lost_poses
from vggtjax.clips.captures.depth_files import read_exr, read_npy, read_png
from vggtjax.clips.captures.files import files
from vggtjax.clips.masks import read_mask
from vggtjax.clips.media.images import ImageFiles, is_image_name
from vggtjax.clips.media.order import in_order
from vggtjax.clips.media.times import in_seconds
from vggtjax.errors import InputError, one_line
from vggtjax.research.evaluation.datasets.folders import sequence_folders
from vggtjax.research.evaluation.datasets.scene_tracks import scene_tracks
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    left_out,
    map_reader,
    unpictured,
)
from vggtjax.storage.trajectories import associate, read_numbers, read_trajectory

_NEW_TAKE = 10.0  # times the median step of the camera: a jump between two takes
_PER_METRE = 1000.0
_DEPTH_FILES: dict[str, Callable[[Path], Float32[np.ndarray, "h w"]]] = {
    ".png": partial(read_png, per_metre=_PER_METRE),
    ".npy": partial(read_npy, per_unit=_PER_METRE),
    ".exr": read_exr,
}
_MASK_FILES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


def plain(root: Path) -> dict[str, Opener]:
    """Find plain folders; a folder with several takes, between which the camera jumps, has a sequence for each take."""
    openers: dict[str, Opener] = {}
    for name, folder in sequence_folders(root, _holds_pictures, "rgb/*.png").items():
        try:
            poses = _known_poses(folder, _pictures(folder)).poses
        except InputError:  # the opener raises it
            poses = None
        parts = [] if poses is None else takes(poses[:, :3, 3])
        if len(parts) < 2:
            openers[name] = partial(_read, folder, name, slice(None))
        for part in parts if len(parts) > 1 else []:
            title = f"{name} {part.start}-{part.stop - 1}"
            openers[title] = partial(_read, folder, title, slice(part.start, part.stop))
    return openers


def takes(centres: Float64[np.ndarray, "S 3"]) -> list[range]:
    """Return the ranges of frames without a cut, a step ten times as long as the median step; pauses do not count.

    Frames without a place, NaN, belong to the take before them.
    """
    placed = np.flatnonzero(np.isfinite(centres).all(axis=1))
    steps = np.linalg.norm(np.diff(centres[placed], axis=0), axis=1)
    moving = steps[steps > 0]
    cuts = placed[1 + np.flatnonzero(steps > _NEW_TAKE * np.median(moving))] if moving.size else np.zeros(0, int)
    return [range(start, end) for start, end in pairwise([0, *cuts.tolist(), len(centres)])]


def _read(folder: Path, name: str, part: slice, frames: FrameChoice) -> LabelledSequence:
    pictures = _pictures(folder)
    known = _known_poses(folder, pictures)
    chosen = frames.of(range(len(pictures))[part], name, pictures[part])
    intrinsics = _intrinsics(folder, len(pictures), known.rows, known.lines)
    taken = [pictures[frame] for frame in chosen]
    depths, unread = _of_one_kind(folder / "depth", _DEPTH_FILES)
    masks, unread_masks = _of_one_kind(folder / "mask", _MASK_FILES)
    found = [depths.get(path.stem) for path in taken]
    depth, gaps, notes = map_reader(
        "depth", taken, found, lambda path: _DEPTH_FILES[path.suffix.lower()](path), folder / "depth" / "*.png"
    )
    notes += unread + unread_masks + known.notes
    mask = None
    if masks:
        paths = [masks.get(path.stem) for path in taken]
        mask, more_gaps, more = map_reader("masks", taken, paths, read_mask, folder / "mask" / "*.png")
        notes, gaps = notes + more, gaps + more_gaps
    stems, truth = [path.stem for path in pictures], {*depths, *masks}
    if part != slice(None):
        every = in_order({*stems} | truth, Path)
        truth = {*every[every.index(stems[part][0]) : every.index(stems[part][-1]) + 1]}
    gaps += unpictured(frames, stems[part], truth, folder / "rgb")
    poses = None if known.poses is None else known.poses[chosen]
    if poses is not None:
        lost = [path.stem for path, pose in zip(taken, poses, strict=True) if not np.isfinite(pose).all()]
        gaps += left_out("poses", lost, len(chosen), "have no pose")
    elif known.notes:
        gaps += left_out("poses", [path.stem for path in taken], len(chosen), "have no pose that is known to be theirs")
    else:
        notes += (f"it has no world_from_camera.txt; expected {folder / 'world_from_camera.txt'}",)
    notes += (f"it has no K.txt; expected {folder / 'K.txt'}",) * (intrinsics is None)
    tracks = None
    if poses is not None and intrinsics is not None and np.isfinite(poses).all():
        tracks = scene_tracks(folder, [path.stem for path in taken], poses, intrinsics[chosen])
    return LabelledSequence(
        name,
        tuple(taken),
        depth,
        mask,
        poses,
        None if intrinsics is None else intrinsics[chosen],
        None if (times := _times(pictures)) is None else times[chosen],
        notes=notes,
        left_out=gaps,
        tracks=tracks,
    )


def _of_one_kind(folder: Path, endings: Iterable[str]) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return the files of the first of the endings that is there, by the stems of their names, and a note on others.

    The same frame in another kind, as generated data sets have it, needs no note.
    """
    there = files(folder, "").values()
    for ending in endings:
        if found := {path.stem: path for path in there if path.suffix.lower() == ending}:
            break
    else:
        found = {}
    others = [path.name for path in there if path.stem not in found]
    note = (
        f"{len(others)} files of its folder {folder.name} are not read, such as {one_line(others[0], 60)}"
        if others
        else ""
    )
    return found, (note,) * bool(note)


def _holds_pictures(folder: Path) -> bool:
    return (folder / "rgb").is_dir() or all((folder / name).exists() for name in ("images", "trajectory.txt"))


def _pictures(folder: Path) -> list[Path]:
    place = folder / ("rgb" if (folder / "rgb").is_dir() else "images")
    pictures = [path for path in place.iterdir() if is_image_name(path) and not path.name.startswith(".")]
    if not pictures:
        raise InputError(f"{place} holds no pictures; expected one for each frame")
    if len({path.stem for path in pictures}) < len(pictures):
        raise InputError(f"{place} holds two pictures of one name; expected one for each frame")
    return in_order(pictures)


class _Known(NamedTuple):
    poses: Float64[np.ndarray, "S 4 4"] | None
    rows: Sequence[int] = ()  # of the file, by picture, where it has another number of poses
    lines: int = 0  # its poses
    notes: tuple[str, ...] = ()


def _known_poses(folder: Path, pictures: list[Path]) -> _Known:
    """Return the poses of pictures, NaN where one has none.

    Where there are not as many poses as pictures, times in trajectory.txt that are those in the pictures' names tell
    which is whose; or a pose is that of the frame of its number among all names of pictures, depth and masks, or of the
    frame whose name counts to it.
    """
    poses = _poses(folder)
    if poses is None or len(poses) == len(pictures):
        return _Known(poses)
    named = [[path.stem for path in files(folder / place, "").values()] for place in ("depth", "mask")]
    stems = [path.stem for path in pictures]
    rows: Sequence[int] = ()
    if (timed := _by_time(folder, pictures)) is not None:
        rows = timed
    elif len(every := in_order({*stems, *named[0], *named[1]}, Path)) == len(poses):
        order = {stem: row for row, stem in enumerate(every)}
        rows = [order[stem] for stem in stems]
    else:
        rows = _counted(stems, len(poses))
    taken = np.full((len(pictures), 4, 4), np.nan)
    if rows:
        for place, row in enumerate(rows):
            taken[place] = poses[row] if row >= 0 else np.nan
        return _Known(taken, rows, len(poses))
    return _Known(
        None,
        notes=(f"it has {len(poses)} poses for {len(pictures)} pictures, and nothing says whose they are; no poses",),
    )


def _by_time(folder: Path, pictures: list[Path]) -> list[int] | None:
    """Return for each picture whose time is known the line of trajectory.txt at that time, or -1."""
    path = folder / "trajectory.txt"
    if (folder / "world_from_camera.txt").is_file() or (times := _times(pictures)) is None:
        return None
    indices = np.full(len(pictures), -1)
    pairs = associate(times, in_seconds(read_trajectory(path, lost=True)[0]))
    indices[pairs[:, 0]] = pairs[:, 1]
    return indices.tolist() if len(pairs) else None


def _counted(stems: list[str], count: int) -> list[int]:
    """Return the places that names count to among `count` from 0 or from 1; empty where nothing says from which."""
    numbers = [int(match[1]) if (match := re.search(r"(\d{1,9})$", stem)) else -1 for stem in stems]
    if min(numbers) < 0 or any(after <= before for before, after in pairwise(numbers)):
        return []
    if numbers[0] == 0 and numbers[-1] < count:
        return numbers
    return [number - 1 for number in numbers] if numbers[-1] == count else []


def _times(pictures: list[Path]) -> Float64[np.ndarray, " S"] | None:
    times = ImageFiles(tuple(pictures)).times
    return None if times is None else times.floats


def _poses(folder: Path) -> Float64[np.ndarray, "S 4 4"] | None:
    path, trajectory = folder / "world_from_camera.txt", folder / "trajectory.txt"
    if not path.is_file():
        return read_trajectory(trajectory, lost=True)[1] if trajectory.is_file() else None
    rows = read_numbers(path, (12, 16), finite=False)
    if rows.shape[1] == 12:
        rows = np.column_stack([rows, np.tile([0.0, 0, 0, 1], (len(rows), 1))])
    return with_lost_poses(rows.reshape(-1, 4, 4), path)


def _intrinsics(
    folder: Path, count: int, places: Sequence[int] = (), poses: int = 0
) -> Float64[np.ndarray, "S 3 3"] | None:
    """Return the intrinsics of `count` pictures; a file of as many as there are `poses` has them at these places."""
    path, focals = folder / "K.txt", folder / "intrinsics.txt"
    if path.is_file():
        rows = read_numbers(path, 3)
    elif focals.is_file():
        rows = np.array([[(fx, 0, cx), (0, fy, cy), (0, 0, 1)] for fx, fy, cx, cy in read_numbers(focals, 4)])
        rows, path = rows.reshape(-1, 3), focals
    else:
        return None
    if places and len(rows) == 3 * poses:
        rows = rows.reshape(-1, 3, 3)[np.maximum(places, 0)].reshape(-1, 3)
    if len(rows) not in (3, 3 * count):
        raise InputError(f"{path} has {len(rows)} rows; expected 3, or 3 for each of {count} pictures")
    return np.broadcast_to(checked_intrinsics(rows.reshape(-1, 3, 3), path), (count, 3, 3))
