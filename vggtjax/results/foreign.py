"""Result folders of other programs, read: VGGT4D's (`vggt4d_files` writes it) and those of seven others.

Files and units are those of their public code:

    vggt4d    frame_0000.png, frame_0000.npy (depth), conf_0000.npy, dynamic_mask_0000.png, and for all frames
              pred_intrinsics.txt (nine numbers a line), pred_traj.txt (world-from-camera, qw before qx qy qz;
              folders of earlier versions of this library have qw last: read these with quaternion="xyzw")
    monst3r   the same with conf_0.npy, dynamic_mask_0.png; the confidence is a logarithm, -inf where it was 0;
              easi3r, das3r and pomato, which build on MonST3R, write the same
    das3r     also as its training takes it: depth_maps/frame_0000.npy, confidence_maps/conf_0000.npy,
              dynamic_masks/dynamic_mask_0000.png, images/frame_0000.png
    cut3r     depth/000000.npy, conf/000000.npy, color/000000.png, camera/000000.npz (pose: world-from-camera;
              intrinsics)
    da3       exports/npz/results.npz or exports/mini_npz/results.npz: depth, conf, extrinsics (camera-from-world),
              intrinsics, and image in the former
    spatialtrackerv2  result.npz, NAME_result.npz or NAME.npz: depths (0 where it is not sure), unc_metric (the
              confidence), extrinsics (camera-from-world), intrinsics, and video, [S, 3, H, W] of shares of white

All have depth along z, dynamic = bright, and intrinsics in pixels of their depth. Does not import jax.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float32

from vggtjax.cameras import Cameras, world_from_camera
from vggtjax.clips.masks import read_mask
from vggtjax.clips.media.images import read_image
from vggtjax.errors import InputError, ResultError, check_choice, reading
from vggtjax.results.foreign_cameras import Posed, text_cameras
from vggtjax.storage.arrays import SIZE_LIMIT, Header, read_array, read_arrays, read_headers
from vggtjax.storage.trajectories import Quaternion

_WHITE = 1.01  # of shares, with rounding
_GREY = 128  # of pictures that a format does not keep

logger = logging.getLogger(__name__)


class _Folder(NamedTuple):
    """A file for each array and frame: the paths of the first frame's files, and the reader of the cameras."""

    depth: str
    picture: str
    confidence: str
    mask: str | None
    cameras: Callable[[Path, Sequence[int], Quaternion | None], Posed]
    logarithmic: bool = False  # confidence


class _Archive(NamedTuple):
    """One .npz file for all frames: the patterns that may name it in a folder, and the names of its arrays."""

    files: tuple[str, ...]
    depth: str
    confidence: str
    images: str
    shares: bool  # pictures are [S, 3, H, W] in [0, 1], or [S, H, W, 3] of 8 bits
    remedy: str


def read_foreign(path: Path, format: str, quaternion: Quaternion | None) -> dict[str, Any]:
    """Read the result folder of another program as fields of a `Result`; see `Reconstruction.load`.

    Raises ClipError or ResultError, without the path, for anything but a whole folder; else what `check_format` raises.
    """
    check_format(format, quaternion)
    if not path.exists() or (format in _FOLDERS and not path.is_dir()):
        raise ResultError("there is no such folder")
    fields = _read_archive(path, _ARCHIVES[format]) if format in _ARCHIVES else _read_folder(path, format, quaternion)
    S, H, W = fields["depth"].shape
    plain = {
        "depth_confidence": np.ones((S, H, W), np.float32),
        "dynamic_mask": np.zeros((S, H, W), bool),
        "images": np.full((S, H, W, 3), _GREY, np.uint8),
    }
    numbers, lost = fields.pop("numbers", range(S)), fields.pop("lost", [])
    missing = [name for name in plain if fields.get(name) is None]
    if missing:
        logger.warning("%s has no %s; plain values stand for them", path, ", ".join(missing))
    made = {
        **plain,
        **{name: value for name, value in fields.items() if value is not None},
        "saliency": None,
        "frame_names": tuple(f"{number:06d}" for number in numbers),
        "timestamps": fields.get("timestamps"),
        "method": format,
        "model_name": format,
        "settings": {"format": format, "quaternion": quaternion, "missing": missing, "lost": lost},
        "source_size": np.tile([H, W], (S, 1)),
        "source_scale": np.ones((S, 2)),
        "source_offset": np.zeros((S, 2)),
        "valid_box": np.tile([0, 0, W, H], (S, 1)),
    }
    return _without_lost(made, path)


def _without_lost(fields: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the frames whose camera is finite: programs write others for frames that they lost."""
    found = np.isfinite(fields["camera_from_world"]).all(axis=(1, 2))
    if found.all() or not found.any():  # `Result` refuses the latter
        return fields
    lost = [name for name, is_found in zip(fields["frame_names"], found, strict=True) if not is_found]
    logger.warning("%s has no finite camera for %d of %d frames, %s first; they are left out",
                   path, len(lost), len(found), lost[0])  # fmt: skip
    names = tuple(name for name, is_found in zip(fields["frame_names"], found, strict=True) if is_found)
    settings = fields["settings"]
    return {name: value[found] if isinstance(value, np.ndarray) else value for name, value in fields.items()} | {
        "frame_names": names,
        "settings": settings | {"lost": sorted([*settings["lost"], *map(int, lost)])},
    }


def check_format(format: str, quaternion: str | None) -> None:
    """Raise InputError for an unknown format, or an order of quaternions that is missing, unknown or not wanted."""
    check_choice("format", format, ("vggtjax", *FORMATS))
    if quaternion is None and format in _WITH_TRAJECTORY:
        raise InputError(
            f"pred_traj.txt of {format} does not say the order of its quaternions; give quaternion 'wxyz' "
            "(--quaternion wxyz), as VGGT4D, MonST3R, CUT3R, Easi3R, DAS3R, POMATO and vggtjax write them, or 'xyzw', "
            "as TUM and earlier vggtjax do"
        )
    if quaternion is not None and (quaternion not in get_args(Quaternion) or format not in _WITH_TRAJECTORY):
        raise InputError(
            f"quaternion is {quaternion!r} for {format}; expected 'xyzw' or 'wxyz' for "
            f"{', '.join(_WITH_TRAJECTORY)}, and none for others, which keep matrices"
        )


def needs_quaternion(format: str) -> bool:
    """Return whether a format has a trajectory, whose order of quaternions has to be given."""
    return format in _WITH_TRAJECTORY


def _read_folder(folder: Path, format: str, quaternion: Quaternion | None) -> dict[str, Any]:
    files = next((files for files in _FOLDERS[format] if _numbered(folder, files.depth)), None)
    if files is None:
        raise ResultError(
            f"it has no depth; expected files like {' or '.join(each.depth for each in _FOLDERS[format])}"
        )
    depth_files = _numbered(folder, files.depth)
    numbers, cameras, times, of_files, every = files.cameras(folder, sorted(depth_files), quaternion)
    if len(of_files) < len(depth_files):
        logger.warning("%s has cameras for %d of %d frames of depth", folder, len(of_files), len(depth_files))
    depth = _stacked(depth_files, of_files, _read_map, None)
    shape = depth.shape[1:]
    confidence = _stacked(_numbered(folder, files.confidence), of_files, _read_map, shape)
    if confidence is not None and files.logarithmic:
        if padded := sorted(path.name for path in folder.glob("conf_0[0-9]*.npy")):
            raise ResultError(
                f"{padded[0]} is numbered as VGGT4D does, whose confidence is no logarithm; load it as vggt4d"
            )
        with np.errstate(over="ignore"):
            confidence = np.exp(confidence).clip(0, np.finfo(np.float32).max)
    mask = None if files.mask is None else _stacked(_numbered(folder, files.mask), of_files, read_mask, shape)
    return {
        "depth": depth,
        "depth_confidence": confidence,
        "dynamic_mask": mask,
        "images": _stacked(
            _numbered(folder, files.picture), of_files, lambda path: np.asarray(read_image(path)), (*shape, 3)
        ),
        **cameras._asdict(),
        "numbers": numbers,
        "lost": sorted({*every} - {*numbers}),
        "timestamps": times,
    }


def _numbered(folder: Path, example: str) -> dict[int, Path]:
    """Return the files of all frames by number, with names like the `example` of frame 0."""
    folder = (folder / example).parent
    pattern = re.sub("0+", r"(\\d{1,9})", re.escape(Path(example).name))
    with reading(folder, ResultError):
        entries = list(folder.iterdir()) if folder.is_dir() else []
    files: dict[int, Path] = {}
    for entry in entries:
        if match := re.fullmatch(pattern, entry.name, re.ASCII):
            number = int(match[1])
            if number in files:
                raise ResultError(f"{files[number].name} and {entry.name} are both of frame {number}")
            files[number] = entry
    return files


def _stacked(
    files: dict[int, Path], numbers: Sequence[int], read: Callable[[Path], np.ndarray], shape: tuple[int, ...] | None
) -> Any:
    """Return the files of all frames as one array, or None without files."""
    if not files:
        return None
    if missing := [number for number in numbers if number not in files]:
        example = next(iter(files.values())).name
        raise ResultError(f"frame {missing[0]} has depth, but no file like {example}; expected one for every frame")
    arrays = None
    for index, number in enumerate(numbers):
        array = read(files[number])
        shape = shape or array.shape
        if array.shape != shape:
            raise ResultError(f"{files[number].name} has shape {array.shape}; expected {shape}, as frame {numbers[0]}")
        if arrays is None:
            if len(numbers) * array.nbytes > SIZE_LIMIT:
                raise ResultError(f"{len(numbers)} frames of {shape} take more than {SIZE_LIMIT} bytes")
            arrays = np.empty((len(numbers), *shape), array.dtype)
        arrays[index] = array
    return arrays


def _read_map(path: Path) -> Float32[np.ndarray, "H W"]:
    array = read_array(path)
    if array.dtype.kind != "f" or array.ndim != 2:
        raise ResultError(f"{path.name} is {array.dtype} {array.shape}; expected floating point [H, W]")
    return array.astype(np.float32)


def _npz_cameras(folder: Path, numbers: Sequence[int], quaternion: Quaternion | None) -> Posed:
    files = _numbered(folder, "camera/000000.npz")
    poses, intrinsics = [], []
    for number in numbers:
        if number not in files:
            raise ResultError(f"frame {number} has depth, but no camera/{number:06d}.npz")
        arrays = _read_some(files[number], {"pose": ((4, 4),), "intrinsics": ((3, 3),)}, {})
        poses.append(arrays["pose"].astype(np.float64))
        intrinsics.append(arrays["intrinsics"].astype(np.float64))
    cameras = Cameras(world_from_camera(np.stack(poses)[:, :3])[:, :3], np.stack(intrinsics))
    return Posed(numbers, cameras, None, numbers, numbers)


def _read_archive(path: Path, names: _Archive) -> dict[str, Any]:
    file = path if path.is_file() else _only_archive(path, names)
    shape = read_headers(file).get(names.depth, Header(np.dtype(float), ())).shape
    if len(shape) != 3 or 0 in shape:
        raise ResultError(f"{names.depth!r} of {file.name} is missing or has shape {shape}; expected (S, H, W)")
    S, H, W = shape
    pictures = (S, 3, H, W) if names.shares else (S, H, W, 3)
    wanted = {names.depth: ((S, H, W),), "extrinsics": ((S, 3, 4), (S, 4, 4)), "intrinsics": ((S, 3, 3),)}
    eight_bits = () if names.shares else (names.images,)
    arrays = _read_some(file, wanted, {names.confidence: ((S, H, W),), names.images: (pictures,)}, eight_bits)
    images = arrays.get(names.images)
    if images is not None and names.shares:
        if not np.abs(images).max() <= _WHITE:
            raise ResultError(
                f"{names.images!r} of {file.name} has values up to {images.max():g}; expected shares of white"
            )
        shares = np.nan_to_num(images).astype(np.float32).transpose(0, 2, 3, 1)
        images = np.clip(255 * shares + 0.5, 0, 255).astype(np.uint8)
    with np.errstate(over="ignore"):
        depth = arrays[names.depth].astype(np.float32)
    return {
        "depth": depth,
        "depth_confidence": arrays.get(names.confidence),
        "images": images,
        "camera_from_world": arrays["extrinsics"][:, :3],
        "intrinsics": arrays["intrinsics"],
    }


def _only_archive(folder: Path, names: _Archive) -> Path:
    """Return the one file of a folder that may be the result: of the first pattern that any file fits."""
    for pattern in names.files:
        with reading(folder, ResultError):
            found = sorted(path for path in folder.glob(pattern) if path.is_file())
        if len(found) > 1:
            raise ResultError(f"{found[0].name} and {found[1].name} may both be the result; give one file")
        if found:
            return found[0]
    raise ResultError(f"it has no {names.files[0]}; {names.remedy}")


def _read_some(
    file: Path,
    needed: Mapping[str, tuple[tuple[int, ...], ...]],
    others: Mapping[str, tuple[tuple[int, ...], ...]],
    eight_bits: Sequence[str] = (),
) -> dict[str, np.ndarray]:
    """Return the arrays of these names, each of one of its shapes; the `others` may be missing.

    Headers are checked first, so that no larger array is read. All arrays are floating point but those of 8 bits.
    """
    headers = read_headers(file)
    for name, shapes in {**needed, **others}.items():
        header, kind = headers.get(name), "uint8" if name in eight_bits else "floating point"
        if header is None and name in needed:
            raise ResultError(f"{file.name} has no {name!r}; expected {kind} {shapes[0]}")
        right = header is None or (header.dtype == np.uint8 if name in eight_bits else header.dtype.kind == "f")
        if header is not None and (header.shape not in shapes or not right):
            raise ResultError(f"{name!r} of {file.name} is {header.dtype} {header.shape}; expected {kind} {shapes[0]}")
    return read_arrays(file, {*needed, *others})


_VGGT4D = _Folder("frame_0000.npy", "frame_0000.png", "conf_0000.npy", "dynamic_mask_0000.png", text_cameras)
_MONST3R = _VGGT4D._replace(logarithmic=True)
_REARRANGED = _Folder(
    "depth_maps/frame_0000.npy",
    "images/frame_0000.png",
    "confidence_maps/conf_0000.npy",
    "dynamic_masks/dynamic_mask_0000.png",
    text_cameras,
    logarithmic=True,
)
_CUT3R = _Folder("depth/000000.npy", "color/000000.png", "conf/000000.npy", None, _npz_cameras)
_FOLDERS: dict[str, tuple[_Folder, ...]] = {
    "vggt4d": (_VGGT4D,),
    "monst3r": (_MONST3R,),
    "easi3r": (_MONST3R,),
    "das3r": (_MONST3R, _REARRANGED),
    "pomato": (_MONST3R,),
    "cut3r": (_CUT3R,),
}
_DA3 = _Archive(
    tuple(f"{folder}results.npz" for folder in ("", "exports/npz/", "exports/mini_npz/", "npz/", "mini_npz/")),
    *("depth", "conf", "image"),
    shares=False,
    remedy="export with the format 'npz' or 'mini_npz'",
)
_SPATIALTRACKER = _Archive(
    ("result.npz", "*_result.npz", "*.npz", "results/*_result.npz"),
    *("depths", "unc_metric", "video"),
    shares=True,
    remedy="inference.py writes it, or NAME_result.npz",
)
_ARCHIVES = {"da3": _DA3, "spatialtrackerv2": _SPATIALTRACKER}
FORMATS = (*_FOLDERS, *_ARCHIVES)
_WITH_TRAJECTORY = tuple(name for name, (files, *_) in _FOLDERS.items() if files.cameras is text_cameras)
