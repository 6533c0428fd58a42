"""Result folders of other projects: VGGT4D's written and read; MonST3R's, CUT3R's and Depth Anything 3's read.

Where each keeps what, and in which unit, was read off their public code:

    vggt4d    frame_0000.png, frame_0000.npy (depth), conf_0000.npy, dynamic_mask_0000.png, and for all frames
              pred_intrinsics.txt (nine numbers a line), pred_traj.txt (world-from-camera)
    monst3r   the same with conf_0.npy, dynamic_mask_0.png; the confidence is a logarithm, -inf where it was 0
    cut3r     depth/000000.npy, conf/000000.npy, color/000000.png, camera/000000.npz (pose, which is world-from-camera,
              and intrinsics)
    da3       exports/npz/results.npz or exports/mini_npz/results.npz: depth, conf, extrinsics (camera-from-world),
              intrinsics, and image in the former

All have depth along z, dynamic = bright, and intrinsics in pixels of their depth. Does not import jax.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image

from vggtjax import cameras as geometry
from vggtjax.clips.images import read_image
from vggtjax.clips.masks import read_mask
from vggtjax.errors import ClipError, InputError, ResultError
from vggtjax.results.frame import Frame
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays as archive
from vggtjax.storage.trajectories import Quaternion, read_numbers, read_trajectory, write_trajectory

_GREY = 128  # of pictures that a layout does not keep

logger = logging.getLogger(__name__)


def write_frame(folder: Path, number: int, frame: Frame) -> None:
    """Write a frame as VGGT4D does."""
    Image.fromarray(frame.image).save(folder / f"frame_{number:04d}.png")
    np.save(folder / f"frame_{number:04d}.npy", frame.depth, allow_pickle=False)
    np.save(folder / f"conf_{number:04d}.npy", frame.confidence, allow_pickle=False)
    mask = Image.fromarray(frame.dynamic_mask.astype(np.uint8) * 255)
    mask.save(folder / f"dynamic_mask_{number:04d}.png")


def write_cameras(
    folder: Path, world_from_camera: Float[np.ndarray, "S 4 4"], intrinsics: Sequence[Float[np.ndarray, "3 3"]]
) -> None:
    """Write the cameras in VGGT4D's files, but the quaternions in TUM's order."""
    np.savetxt(folder / "pred_intrinsics.txt", np.stack(intrinsics).reshape(-1, 9), fmt="%.9g")
    write_trajectory(folder / "pred_traj.txt", world_from_camera, np.arange(len(world_from_camera), dtype=np.float64))


class Cameras(NamedTuple):
    """Cameras of S frames."""

    camera_from_world: Float[np.ndarray, "S 3 4"]
    intrinsics: Float[np.ndarray, "S 3 3"]


class _Folder(NamedTuple):
    """Where a layout keeps a frame's files, as patterns of their paths with the frame's number, and its cameras."""

    example: str  # of a depth file
    depth: str
    picture: str
    confidence: str
    mask: str | None
    cameras: Callable[[Path, Sequence[int], Quaternion | None], Cameras]
    logarithmic: bool = False  # confidence


def load_foreign(path: Path, layout: str, quaternion: Quaternion | None) -> Reconstruction:
    """Read a result folder of another project; see `Reconstruction.load`."""
    if layout not in LAYOUTS:
        raise InputError(f"layout is {layout!r}; expected one of vggtjax, {', '.join(LAYOUTS)}")
    check_quaternion(layout, quaternion)
    try:
        if not path.exists() or (layout != "da3" and not path.is_dir()):
            raise ResultError("there is no such folder")
        fields = _read_da3(path) if layout == "da3" else _read_folder(path, _FOLDERS[layout], quaternion)
        S, H, W = fields["depth"].shape
        plain: dict[str, Any] = {
            "depth_confidence": np.ones((S, H, W), np.float32),
            "dynamic_mask": np.zeros((S, H, W), bool),
            "images": np.full((S, H, W, 3), _GREY, np.uint8),
        }
        missing = [name for name in plain if fields.get(name) is None]
        result = Reconstruction(
            **(plain | {name: value for name, value in fields.items() if value is not None}),
            saliency=None,
            frame_names=tuple(f"{number:06d}" for number in range(S)),
            timestamps=None,
            method=layout,
            model_name=layout,
            settings={"layout": layout, "quaternion": quaternion, "missing": missing},
            source_size=np.tile([H, W], (S, 1)),
            source_scale=np.ones((S, 2)),
            source_offset=np.zeros((S, 2)),
            valid_box=np.tile([0, 0, W, H], (S, 1)),
        )
    except (ClipError, ResultError) as error:
        raise ResultError(f"{path} cannot be loaded as a result of {layout}: {error}") from error
    if missing:
        logger.warning("%s has no %s; plain values stand for them", path, ", ".join(missing))
    return result


def check_quaternion(layout: str, quaternion: str | None) -> None:
    """Raise InputError where a layout needs the order of its quaternions, or has none."""
    if quaternion is None and layout in _WITH_TRAJECTORY:
        raise InputError(
            f"pred_traj.txt of {layout} does not say the order of its quaternions; give quaternion='wxyz' (what "
            "VGGT4D, MonST3R, CUT3R and Easi3R write) or 'xyzw' (TUM's order, what vggtjax writes)"
        )
    if quaternion is not None and (quaternion not in get_args(Quaternion) or layout not in _WITH_TRAJECTORY):
        raise InputError(
            f"quaternion is {quaternion!r} for {layout}; expected 'xyzw' or 'wxyz' for "
            f"{' and '.join(_WITH_TRAJECTORY)}, and none for others, which keep matrices"
        )


def _read_folder(folder: Path, layout: _Folder, quaternion: Quaternion | None) -> dict[str, Any]:
    depth_files = _numbered(folder, layout.depth)
    if not depth_files:
        raise ResultError(f"it has no depth; expected files like {layout.example}")
    numbers = sorted(depth_files)
    cameras = layout.cameras(folder, numbers, quaternion)
    depth = _stacked(depth_files, numbers, _read_map, None)
    shape = depth.shape[1:]
    confidence = _stacked(_numbered(folder, layout.confidence), numbers, _read_map, shape)
    if confidence is not None and layout.logarithmic:
        if padded := sorted(path.name for path in folder.glob("conf_0[0-9]*.npy")):
            raise ResultError(
                f"{padded[0]} is numbered as VGGT4D does, whose confidence is no logarithm; load it as that"
            )
        with np.errstate(over="ignore"):
            confidence = np.exp(confidence).clip(0, np.finfo(np.float32).max)
    mask = None if layout.mask is None else _stacked(_numbered(folder, layout.mask), numbers, read_mask, shape)
    return {
        "depth": depth,
        "depth_confidence": confidence,
        "dynamic_mask": mask,
        "images": _stacked(_numbered(folder, layout.picture), numbers, _read_picture, (*shape, 3)),
        **cameras._asdict(),
    }


def _numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Return the files of a folder by the number in their names."""
    parent, _, name = pattern.rpartition("/")
    place = folder / parent if parent else folder
    try:
        found = (
            [(re.fullmatch(name, entry.name, re.ASCII), entry) for entry in place.iterdir()] if place.is_dir() else []
        )
    except OSError as error:
        raise ResultError(f"it cannot be read ({error.strerror or error})") from error
    files: dict[int, Path] = {}
    for match, entry in found:
        if match:
            number = int(match[1])
            if number in files:
                raise ResultError(f"{files[number].name} and {entry.name} are both of frame {number}")
            files[number] = entry
    return files


def _stacked(
    files: dict[int, Path], numbers: Sequence[int], read: Callable[[Path], np.ndarray], shape: tuple[int, ...] | None
) -> Any:
    """Return the files of all frames as one array, or None where there is not a single one."""
    if not files:
        return None
    if missing := [number for number in numbers if number not in files]:
        like = next(iter(files.values())).name
        raise ResultError(f"frame {missing[0]} has depth, but no file like {like}; expected one for every frame")
    arrays = None
    for place, number in enumerate(numbers):
        array = read(files[number])
        shape = shape or array.shape
        if array.shape != shape:
            raise ResultError(f"{files[number].name} has shape {array.shape}; expected {shape}, as frame {numbers[0]}")
        if arrays is None:
            if len(numbers) * array.nbytes > archive.SIZE_LIMIT:
                raise ResultError(f"{len(numbers)} frames of {shape} take more than {archive.SIZE_LIMIT} bytes")
            arrays = np.empty((len(numbers), *shape), array.dtype)
        arrays[place] = array
    return arrays


def _read_map(path: Path) -> Float32[np.ndarray, "H W"]:
    array = archive.read_array(path)
    if array.dtype.kind != "f" or array.ndim != 2:
        raise ResultError(f"{path.name} is {array.dtype} {array.shape}; expected floating point [H, W]")
    return array.astype(np.float32)


def _read_picture(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    return np.asarray(read_image(path))


def _text_cameras(folder: Path, numbers: Sequence[int], quaternion: Quaternion | None) -> Cameras:
    if quaternion is None:
        raise InputError("quaternion is None; expected 'xyzw' or 'wxyz'")
    poses = read_trajectory(folder / "pred_traj.txt", quaternion)[1]
    intrinsics = read_numbers(folder / "pred_intrinsics.txt", 9).reshape(-1, 3, 3)
    for name, array in (("pred_traj.txt", poses), ("pred_intrinsics.txt", intrinsics)):
        if len(array) != len(numbers):
            raise ResultError(
                f"{name} has {len(array)} lines for {len(numbers)} frames of depth; expected one for each"
            )
    return Cameras(geometry.world_from_camera(poses[:, :3])[:, :3], intrinsics)  # the inverse, whichever way


def _npz_cameras(folder: Path, numbers: Sequence[int], quaternion: Quaternion | None) -> Cameras:
    files = _numbered(folder, r"camera/(\d+)\.npz")
    poses, intrinsics = [], []
    for number in numbers:
        if number not in files:
            raise ResultError(f"frame {number} has depth, but no camera/{number:06d}.npz")
        arrays = _read_some(files[number], {"pose": ((4, 4),), "intrinsics": ((3, 3),)}, {})
        poses.append(arrays["pose"].astype(np.float64))
        intrinsics.append(arrays["intrinsics"].astype(np.float64))
    return Cameras(geometry.world_from_camera(np.stack(poses)[:, :3])[:, :3], np.stack(intrinsics))


def _read_da3(path: Path) -> dict[str, Any]:
    places = [
        path,
        *(path / below / "results.npz" for below in ("", "exports/npz", "exports/mini_npz", "npz", "mini_npz")),
    ]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise ResultError("it has no results.npz; export with the format 'npz' or 'mini_npz'")
    shape = archive.read_headers(file).get("depth", archive.Header(np.dtype(float), ())).shape
    if len(shape) != 3 or 0 in shape:
        raise ResultError(f"'depth' of {file.name} is missing or has shape {shape}; expected (N, H, W)")
    S, H, W = shape
    wanted = {"depth": ((S, H, W),), "extrinsics": ((S, 3, 4), (S, 4, 4)), "intrinsics": ((S, 3, 3),)}
    arrays = _read_some(file, wanted, {"conf": ((S, H, W),), "image": ((S, H, W, 3),)})
    with np.errstate(over="ignore"):
        depth = arrays["depth"].astype(np.float32)
    return {
        "depth": depth,
        "depth_confidence": arrays.get("conf"),
        "images": arrays.get("image"),
        "camera_from_world": arrays["extrinsics"][:, :3],
        "intrinsics": arrays["intrinsics"],
    }


def _read_some(
    file: Path, needed: Mapping[str, tuple[tuple[int, ...], ...]], others: Mapping[str, tuple[tuple[int, ...], ...]]
) -> dict[str, np.ndarray]:
    """Return the arrays of these names, of one of the shapes given for each; `others` need not be there.

    Headers are looked at first, so that nothing larger is ever read. All are floating point but `image`, 8 bits.
    """
    headers = archive.read_headers(file)
    for name, shapes in {**needed, **others}.items():
        header, kind = headers.get(name), "uint8" if name == "image" else "floating point"
        if header is None and name in needed:
            raise ResultError(f"{file.name} has no {name!r}; expected {kind} {shapes[0]}")
        right = header is None or (header.dtype == np.uint8 if name == "image" else header.dtype.kind == "f")
        if header is not None and (header.shape not in shapes or not right):
            raise ResultError(f"{name!r} of {file.name} is {header.dtype} {header.shape}; expected {kind} {shapes[0]}")
    return archive.read_arrays(file, {*needed, *others})


_MONST3R = _Folder(
    example="frame_0000.npy",
    depth=r"frame_(\d{1,9})\.npy",
    picture=r"frame_(\d{1,9})\.png",
    confidence=r"conf_(\d{1,9})\.npy",
    mask=r"dynamic_mask_(\d{1,9})\.png",
    cameras=_text_cameras,
    logarithmic=True,
)
_FOLDERS = {
    "vggt4d": _MONST3R._replace(logarithmic=False),
    "monst3r": _MONST3R,
    "cut3r": _Folder(
        example="depth/000000.npy",
        depth=r"depth/(\d{1,9})\.npy",
        picture=r"color/(\d{1,9})\.png",
        confidence=r"conf/(\d{1,9})\.npy",
        mask=None,
        cameras=_npz_cameras,
    ),
}
LAYOUTS = (*_FOLDERS, "da3")
_WITH_TRAJECTORY = tuple(name for name, layout in _FOLDERS.items() if layout.cameras is _text_cameras)
