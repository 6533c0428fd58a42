"""Plain folders: rgb/, and optionally depth/, mask/, K.txt and world_from_camera.txt. Does not import jax.

Clips of `vggtjax scenes` are read too: images/, intrinsics.txt and trajectory.txt stand for the first and the last two.

Depth is PNG of 16 bits in millimetres, .npy in metres (of whole numbers: in millimetres) or .exr in metres, 0 where it
is unknown; masks are pictures of any kind, bright where the world moves. K.txt has three rows of three numbers for all
frames, or three rows for each; world_from_camera.txt a row of 16 numbers for each frame, or of 12 as KITTI's, in
metres. Intrinsics are not shifted by half a pixel: the pixel origin of the HoloLens is unknown, and half a pixel is
below the accuracy of its poses and depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.captures.cameras import checked_intrinsics, checked_world_from_camera
from vggtjax.captures.depth_files import read_exr, read_npy, read_png
from vggtjax.captures.files import files
from vggtjax.clips.masks import read_mask
from vggtjax.errors import InputError, one_line
from vggtjax.evaluation.datasets.folders import sequence_folders
from vggtjax.evaluation.datasets.sequence import FrameChoice, LabelledSequence, Opener, depth_reader, mask_reader
from vggtjax.media.images import is_image_name
from vggtjax.media.order import in_order
from vggtjax.storage.trajectories import read_numbers, read_trajectory

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
            poses = _poses(folder)
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
    """Return the ranges of frames without a cut, a step ten times as long as the median step; pauses do not count."""
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    moving = steps[steps > 0]
    cuts = 1 + np.flatnonzero(steps > _NEW_TAKE * np.median(moving)) if moving.size else np.zeros(0, int)
    return [range(start, end) for start, end in pairwise([0, *cuts.tolist(), len(centres)])]


def _read(folder: Path, name: str, part: slice, frames: FrameChoice) -> LabelledSequence:
    pictures = _pictures(folder)
    poses = _poses(folder)
    if poses is not None and len(poses) != len(pictures):
        raise InputError(
            f"{folder / 'world_from_camera.txt'} has {len(poses)} poses; expected {len(pictures)}, one for each picture"
        )
    chosen = frames.of(range(len(pictures))[part], name)
    intrinsics = _intrinsics(folder, len(pictures))
    taken = [pictures[frame] for frame in chosen]
    depths, unread = _of_one_kind(folder / "depth", _DEPTH_FILES)
    masks, unread_masks = _of_one_kind(folder / "mask", _MASK_FILES)
    found = [depths.get(path.stem) for path in taken]
    depth, notes = depth_reader(taken, found, _read_depth, folder / "depth" / "*.png")
    notes += unread + unread_masks
    mask = None
    if masks:
        mask, more = mask_reader(taken, [masks.get(path.stem) for path in taken], read_mask, folder / "mask" / "*.png")
        notes += more
    for file, read in (("world_from_camera.txt", poses), ("K.txt", intrinsics)):
        notes += (f"it has no {file}; expected {folder / file}",) * (read is None)
    return LabelledSequence(
        name,
        tuple(taken),
        depth,
        mask,
        None if poses is None else poses[chosen],
        None if intrinsics is None else intrinsics[chosen],
        notes=notes,
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


def _read_depth(path: Path) -> Float32[np.ndarray, "h w"]:
    return _DEPTH_FILES[path.suffix.lower()](path)


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


def _poses(folder: Path) -> Float64[np.ndarray, "S 4 4"] | None:
    path, trajectory = folder / "world_from_camera.txt", folder / "trajectory.txt"
    if not path.is_file():
        return read_trajectory(trajectory)[1] if trajectory.is_file() else None
    rows = read_numbers(path, (12, 16))
    if rows.shape[1] == 12:
        rows = np.column_stack([rows, np.tile([0.0, 0, 0, 1], (len(rows), 1))])
    return checked_world_from_camera(rows.reshape(-1, 4, 4), path)


def _intrinsics(folder: Path, count: int) -> Float64[np.ndarray, "S 3 3"] | None:
    path, focals = folder / "K.txt", folder / "intrinsics.txt"
    if path.is_file():
        rows = read_numbers(path, 3)
    elif focals.is_file():
        rows = np.array([[(fx, 0, cx), (0, fy, cy), (0, 0, 1)] for fx, fy, cx, cy in read_numbers(focals, 4)])
        rows, path = rows.reshape(-1, 3), focals
    else:
        return None
    if len(rows) not in (3, 3 * count):
        raise InputError(f"{path} has {len(rows)} rows; expected 3, or 3 for each of {count} pictures")
    return np.broadcast_to(checked_intrinsics(rows.reshape(-1, 3, 3), path), (count, 3, 3))
