"""DyCheck's iPhone sequences as Shape of Motion released them, at 1x. Does not import jax.

splits/train.json names the frames; rgb/1x/<frame>.png are their pictures, camera/<frame>.json their cameras and
depth/1x/<frame>.npy what the lidar measured. Pixels count from the outer corner of the first (DyCheck's rays pass
through whole numbers and a half). https://github.com/KAIR-BAIR/dycheck/blob/main/docs/DATASETS.md calls the depth
millimetres; its code, and that of Shape of Motion, takes it in the unit of the cameras' positions, which are metres.
flow3d_preprocessed/ adds cameras refined with COLMAP (colmap/sparse) and disparity of Depth Anything aligned to them
(aligned_depth_anything_colmap/1x), in COLMAP's unit. https://github.com/vye16/shape-of-motion
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import (
    DISTORTED,
    checked_intrinsics,
    resized_intrinsics,
    with_lost_poses,
    world_from_camera_of,
)
from vggtjax.clips.captures.colmap_model import read_views
from vggtjax.clips.captures.depth_files import read_npy
from vggtjax.clips.captures.files import files, inside
from vggtjax.clips.captures.lens import check_no_fisheye
from vggtjax.clips.captures.numbers import numbers
from vggtjax.clips.captures.pictures import picture_size
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
from vggtjax.storage.json_values import read_json

EASI3R, LIDAR = TRUTHS = ("easi3r", "lidar")
_SPLIT = Path("splits/train.json")
_PICTURES = Path("rgb/1x")
_LIDAR = Path("depth/1x")
_ALIGNED = Path("flow3d_preprocessed/aligned_depth_anything_colmap/1x")
_MODEL = Path("flow3d_preprocessed/colmap/sparse")
_LEAST_DISPARITY = 1e-3
_FARTHEST = 2.5  # times the median over the frames of their largest depth


class _Cameras(NamedTuple):
    world_from_camera: Float64[np.ndarray, "S 4 4"] | None
    intrinsics: Float64[np.ndarray, "S 3 3"] | None
    notes: tuple[str, ...]
    left_out: tuple[LeftOut, ...] = ()


def dycheck(root: Path, gt: str = EASI3R) -> dict[str, Opener]:
    """Find sequences. Their ground truth is "easi3r", disparity aligned to COLMAP with COLMAP's cameras, or "lidar"."""
    folders = sequence_folders(root, lambda folder: (folder / _SPLIT).is_file(), str(_SPLIT))
    return {name: partial(_read, folder, name, gt) for name, folder in folders.items()}


def _read(folder: Path, name: str, gt: str, frames: FrameChoice) -> LabelledSequence:
    names = _frame_names(folder / _SPLIT)
    chosen = frames.of(names, name)
    paths = {frame: inside(folder / _PICTURES, f"{frame}.png", folder / _SPLIT) for frame in chosen}
    absent = [frame for frame, path in paths.items() if not path.is_file()]
    if len(absent) == len(chosen):
        raise InputError(f"{paths[absent[0]]} is missing, and so is every picture that {folder / _SPLIT} names")
    gaps = left_out("pictures", absent, len(chosen), "have no picture", folder / _PICTURES)
    chosen = [frame for frame in chosen if frame not in absent]
    pictures = [paths[frame] for frame in chosen]
    easi3r = gt == EASI3R
    cameras = (_colmap_cameras if easi3r else _json_cameras)(folder, chosen, pictures)
    maps_folder = folder / (_ALIGNED if easi3r else _LIDAR)
    maps = files(maps_folder, ".npy")
    read = _from_disparity([maps[frame] for frame in names if frame in maps]) if easi3r else read_npy
    depth, more, notes = map_reader(
        "depth", pictures, [maps.get(frame) for frame in chosen], read, maps_folder / "*.npy"
    )
    return LabelledSequence(
        name,
        tuple(pictures),
        depth,
        world_from_camera=cameras.world_from_camera,
        intrinsics=cameras.intrinsics,
        notes=(f"its ground truth is {gt}", *notes, *cameras.notes),
        left_out=gaps + more + cameras.left_out,
    )


def _frame_names(path: Path) -> list[str]:
    names = read_json(path, dict[str, Any], "split").get("frame_names")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path} has no list of names under 'frame_names'; expected the train split of a sequence")
    for name in names:
        inside(path.parent, name, path)
    if len(set(names)) < len(names):
        raise InputError(f"{path} names a frame twice; expected each once")
    return names


def _from_disparity(paths: list[Path]) -> Callable[[Path], Float32[np.ndarray, "h w"]]:
    """Return a reader of depth, 1 / disparity, with Shape of Motion's largest depth over all frames of the split."""

    @cache
    def farthest() -> float:
        largest = sorted(float(_inverse(path).max(initial=0)) for path in paths)
        return _FARTHEST * largest[(len(largest) - 1) // 2]  # torch's median: the lower of the two in the middle

    return lambda path: np.minimum(_inverse(path), np.float32(farthest()))


def _inverse(path: Path) -> Float32[np.ndarray, "h w"]:
    disparity = read_npy(path)
    if not np.isfinite(disparity).all():
        raise InputError(f"{path} has values that are not finite; expected disparity")
    return 1 / np.maximum(disparity, np.float32(_LEAST_DISPARITY))


def _colmap_cameras(folder: Path, frames: list[str], pictures: list[Path]) -> _Cameras:
    source = folder / _MODEL
    if not (source / "images.bin").is_file():
        return _Cameras(None, None, (f"it has no cameras; expected {source / 'images.bin'}",))
    views = read_views(source)
    missing = [frame for frame in frames if f"{frame}.png" not in views]
    if len(missing) == len(frames):
        return _Cameras(None, None, (f"it has no cameras: none of its frames is in {_MODEL}",))
    taken = {place: views[f"{frame}.png"] for place, frame in enumerate(frames) if f"{frame}.png" in views}
    check_no_fisheye((view.lens for view in taken.values()), source)
    intrinsics = {
        place: resized_intrinsics(view.intrinsics, view.size, picture_size(pictures[place]), source)
        for place, view in taken.items()
    }
    known = world_from_camera_of(np.stack([view.camera_from_world for view in taken.values()]), source)
    notes = (DISTORTED,) * any(view.lens for view in taken.values())
    gaps = left_out("poses", missing, len(frames), f"are not in {_MODEL}")
    return _with_gaps(dict(zip(taken, known, strict=True)), intrinsics, len(frames))._replace(
        notes=notes, left_out=gaps
    )


def _with_gaps(
    poses: dict[int, Float64[np.ndarray, "4 4"]], intrinsics: dict[int, Float64[np.ndarray, "3 3"]], count: int
) -> _Cameras:
    """Return the cameras of `count` frames, of which some have none: NaN, and the intrinsics of another frame."""
    other = next(iter(intrinsics.values()))
    nowhere = np.full((4, 4), np.nan)
    return _Cameras(
        np.stack([poses.get(place, nowhere) for place in range(count)]),
        np.stack([intrinsics.get(place, other) for place in range(count)]),
        (),
    )


def _json_cameras(folder: Path, frames: list[str], pictures: list[Path]) -> _Cameras:
    paths = [folder / "camera" / f"{frame}.json" for frame in frames]
    poses, intrinsics, distorted = {}, {}, False
    for place, (path, picture) in enumerate(zip(paths, pictures, strict=True)):
        if not path.is_file():
            continue
        camera = read_json(path, dict[str, Any], "camera")
        pose = np.eye(4)
        pose[:3, :3] = numbers(camera, "orientation", ((3, 3),), path, finite=False).T  # the file: camera-from-world
        pose[:3, 3] = numbers(camera, "position", ((3,),), path, finite=False)
        pose = with_lost_poses(pose[None], path)[0]
        if not np.isfinite(pose).all():
            continue
        poses[place] = pose
        focal, skew, ratio = (
            float(numbers(camera, key, ((),), path)) for key in ("focal_length", "skew", "pixel_aspect_ratio")
        )
        cx, cy = numbers(camera, "principal_point", ((2,),), path)
        width, height = numbers(camera, "image_size", ((2,),), path).tolist()
        if min(width, height) < 1:
            raise InputError(f"{path} has an image_size of {width:g} x {height:g}; expected pixels")
        matrix = checked_intrinsics(np.array([[focal, skew, cx], [0, focal * ratio, cy], [0, 0, 1]]), path)
        intrinsics[place] = resized_intrinsics(matrix, (width, height), picture_size(picture), path)
        for key, count in (("radial_distortion", 3), ("tangential_distortion", 2)):
            distorted |= bool(numbers(camera, key, ((count,),), path).any())
    if not poses:
        return _Cameras(None, None, (f"it has no cameras; expected {folder / 'camera' / '*.json'}",))
    missing = [frame for place, frame in enumerate(frames) if place not in poses]
    gaps = left_out("poses", missing, len(frames), "have no camera", folder / "camera" / "*.json")
    return _with_gaps(poses, intrinsics, len(frames))._replace(notes=(DISTORTED,) * distorted, left_out=gaps)
