"""Data sets with a layout of folders each: DAVIS, Sintel, 7-Scenes and KITTI. Does not import jax.

DAVIS 2016 and 2017 at 480p: JPEGImages/480p/<sequence>/%05d.jpg, Annotations/480p/<sequence>/%05d.png. Any label
above 0 is dynamic. https://davischallenge.org/davis2017/code.html.

MPI Sintel's training sequences with depth and cameras, final pass. training/final/<sequence>/frame_%04d.png, and of
the same names training/depth/*.dpt, in metres, and training/camdata_left/*.cam: a tag, K as nine 64-bit floats,
camera-from-world as twelve. Pixels count from the centre of the first: the principal point of 1024 x 436 pictures is
(511.5, 217.5), their middle. http://sintel.is.tue.mpg.de/depth, `sintel_io.py`

7-Scenes: seq-XX/frame-%06d.color.png, .depth.png and .pose.txt. Depth is PNG of 16 bits in millimetres, 65535 and 0
where it is unknown; poses are camera-to-world, 4 x 4, in metres. The page says that colour and depth are not
calibrated, so depth is not at exactly the pixels of the pictures, and gives one camera, KinectFusion's default for
the depth: focal length 585, principal point (320, 240). Its pixel origin is unknown; the centre of the first pixel is
taken to be 0. https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/

KITTI's annotated depth with the pictures of the raw drives, left colour camera. Depth is
val/<drive>/proj_depth/groundtruth/image_02/%010d.png, of 16 bits, 256 to the metre, 0 where it is unknown (the depth
benchmark's readme); its pictures are <date>/<drive>/image_02/data or val/<drive>/image_02/data. MonST3R's gathered
folders are read too: image_gathered/<drive>_02 and groundtruth_depth_gathered/<drive>_02. Intrinsics are P_rect_02 of
<date>/calib_cam_to_cam.txt. KITTI does not say from where its pixels count: as in OpenCV, whose calibration it uses,
the centre of the first is taken to be 0. https://www.cvlibs.net/datasets/kitti
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.captures.cameras import (
    PIXEL_CENTRE,
    checked_intrinsics,
    intrinsics_matrix,
    with_lost_poses,
    world_from_camera_of,
)
from vggtjax.clips.captures.depth_files import SINTEL_TAG, read_dpt, read_png
from vggtjax.clips.captures.files import files, read_bytes, read_text
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import sequence_folders, subfolders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    left_out,
    map_reader,
    read_labels,
    unpictured,
)
from vggtjax.storage.trajectories import read_numbers

_RESOLUTION = "480p"  # of DAVIS


def davis(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder that holds JPEGImages and Annotations."""
    folders = subfolders(root / "JPEGImages" / _RESOLUTION)
    if folders:
        return {folder.name: partial(_read_davis, root, folder.name) for folder in folders}
    raise InputError(f"{root} holds no sequence of DAVIS; expected {root / 'JPEGImages' / _RESOLUTION}/SEQUENCE/*.jpg")


def _read_davis(root: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    source, folder = root / "JPEGImages" / _RESOLUTION / name, root / "Annotations" / _RESOLUTION / name
    every, labels = _pictures(source, ".jpg"), files(folder, ".png")
    pictures = frames.of(every, name)
    paths = [labels.get(path.stem) for path in pictures]
    mask, missing, notes = map_reader("masks", pictures, paths, read_labels, folder / "*.png")
    missing += unpictured(frames, (path.stem for path in every), labels, source)
    return LabelledSequence(name, tuple(pictures), mask=mask, notes=notes, left_out=missing)


def _pictures(folder: Path, ending: str) -> list[Path]:
    if pictures := list(files(folder, ending).values()):
        return pictures
    raise InputError(f"the sequence has no pictures; expected {folder / f'*{ending}'}")


# Sintel
_CAM_BYTES = 4 + 8 * (9 + 12)


def sintel(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder training/, or of the folder around it."""
    for folder in (root / "training", root):
        if names := [child.name for child in subfolders(folder / "final")]:
            return {name: partial(_read_sintel, folder, name) for name in names}
    raise InputError(f"{root} holds no sequence of Sintel; expected {root}/training/final/SEQUENCE/frame_*.png")


def read_cam(path: Path) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3 4"]]:
    """Read a camera: K, with pixels counted from the centre of the first, and camera-from-world."""
    data = read_bytes(path)
    if data[:4] != SINTEL_TAG or len(data) != _CAM_BYTES:
        raise InputError(
            f"{path} has {len(data)} bytes and starts with {data[:4]!r}; expected {_CAM_BYTES} that start with "
            f"{SINTEL_TAG!r}, the tag of a Sintel camera"
        )
    values = np.frombuffer(data, "<f8", offset=4).astype(np.float64)
    return values[:9].reshape(3, 3), values[9:].reshape(3, 4)


def _read_sintel(training: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    every = _pictures(training / "final" / name, ".png")
    pictures = frames.of(every, name)
    source = training / "camdata_left" / name
    depths, cams = files(training / "depth" / name, ".dpt"), files(source, ".cam")
    expected = training / "depth" / name / "*.dpt"
    depth, gaps, notes = map_reader("depth", pictures, [depths.get(path.stem) for path in pictures], read_dpt, expected)
    gaps += unpictured(frames, (path.stem for path in every), {*depths, *cams}, training / "final" / name)
    poses = intrinsics = None
    cameras = [read_cam(cams[path.stem]) if path.stem in cams else None for path in pictures]
    seen = [camera is not None and all(map(finite, camera)) for camera in cameras]
    lost = [path.stem for path, found in zip(pictures, seen, strict=True) if not found]
    if len(lost) == len(pictures):
        notes += (f"it has no cameras; expected {source / '*.cam'}",)
    else:
        found = [camera for camera, sees in zip(cameras, seen, strict=True) if camera is not None and sees]
        matrices, camera_from_world = (np.stack(values) for values in zip(*found, strict=True))
        intrinsics = np.tile(checked_intrinsics(matrices, source)[:1], (len(pictures), 1, 1))
        intrinsics[seen] = matrices
        intrinsics[:, :2, 2] += PIXEL_CENTRE
        poses = np.full((len(pictures), 4, 4), np.nan)
        poses[seen] = world_from_camera_of(camera_from_world, source)
        gaps += left_out("poses", lost, len(pictures), "have no camera", source / "*.cam")
    return LabelledSequence(
        name, tuple(pictures), depth, world_from_camera=poses, intrinsics=intrinsics, notes=notes, left_out=gaps
    )


def finite(array: Float64[np.ndarray, ...]) -> bool:
    """Return whether all values of an array are finite."""
    return bool(np.isfinite(array).all())


# 7-Scenes
_MILLIMETRES = 1000.0
_INVALID = 65535
_CAMERA = (585.0, 585.0, 320.0, 240.0)
_PICTURE, _DEPTH, _POSE = ".color.png", ".depth.png", ".pose.txt"


def seven_scenes(root: Path) -> dict[str, Opener]:
    """Find the sequences of a scene (names such as "seq-01") or of a folder of scenes ("chess/seq-01")."""
    folders = sequence_folders(root, lambda folder: bool(files(folder, _PICTURE)), f"*{_PICTURE}", levels=2)
    return {name: partial(_read_seven_scenes, folder, name) for name, folder in folders.items()}


def _read_seven_scenes(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures, depths, pose_files = (files(folder, ending) for ending in (_PICTURE, _DEPTH, _POSE))
    chosen = frames.of(list(pictures), name)
    taken = [pictures[frame] for frame in chosen]
    read = partial(read_png, per_metre=_MILLIMETRES, invalid=_INVALID)
    depth, gaps, notes = map_reader(
        "depth", taken, [depths.get(frame) for frame in chosen], read, folder / f"*{_DEPTH}"
    )
    gaps += unpictured(frames, pictures, {*depths, *pose_files}, folder / f"*{_PICTURE}")
    nowhere = np.full((4, 4), np.nan)
    poses = np.stack([_pose(pose_files[frame]) if frame in pose_files else nowhere for frame in chosen])
    lost = [frame for frame, pose in zip(chosen, poses, strict=True) if not finite(pose)]
    if len(lost) == len(chosen):
        poses = None
        notes += (f"it has no poses; expected {folder / f'*{_POSE}'}",)
    else:
        gaps += left_out("poses", lost, len(chosen), "have no pose", folder / f"*{_POSE}")
    intrinsics = np.broadcast_to(intrinsics_matrix(*_CAMERA, first_pixel=0, source="7-Scenes"), (len(taken), 3, 3))
    notes += ("depth is not registered to the pictures; the intrinsics are the depth camera's",)
    return LabelledSequence(
        name, tuple(taken), depth, world_from_camera=poses, intrinsics=intrinsics, notes=notes, left_out=gaps
    )


def _pose(path: Path) -> Float64[np.ndarray, "4 4"]:
    rows = read_numbers(path, 4, finite=False)
    if len(rows) != 4:
        raise InputError(f"{path} has {len(rows)} rows; expected a pose of 4 rows")
    return with_lost_poses(rows[None], path)[0]


# KITTI
_PER_METRE = 256.0
_TRUTH = Path("proj_depth/groundtruth/image_02")
_PICTURES = Path("image_02/data")
_GATHERED = "groundtruth_depth_gathered"
_DATE = len("2011_09_26")  # what a drive's name starts with
_CALIBRATION = "calib_cam_to_cam.txt"
_PROJECTION = "P_rect_02"


def kitti(root: Path) -> dict[str, Opener]:
    """Find the drives of a folder with val/, or of MonST3R's folder of gathered drives."""
    openers: dict[str, Opener] = {}
    for drive in subfolders(root / "val"):
        if (drive / _TRUTH).is_dir():
            date = root / drive.name[:_DATE]
            places = (date / drive.name / _PICTURES, drive / _PICTURES)
            pictures = next((place for place in places if place.is_dir()), places[0])
            openers[drive.name] = partial(_read_kitti, drive.name, drive / _TRUTH, pictures, date / _CALIBRATION)
    for drive in subfolders(root / _GATHERED):
        name = drive.name.removesuffix("_02")
        if name not in openers:
            pictures = root / "image_gathered" / drive.name
            openers[name] = partial(_read_kitti, name, drive, pictures, root / _CALIBRATION)
    if not openers:
        places = f"{root / 'val' / 'DRIVE' / _TRUTH} or {root / _GATHERED}/DRIVE_02"
        raise InputError(f"{root} holds no drive of KITTI; expected {places}")
    return openers


def _read_kitti(name: str, truth: Path, folder: Path, calibration: Path, frames: FrameChoice) -> LabelledSequence:
    depths, pictures = files(truth, ".png"), files(folder, ".png")
    if not depths or not pictures:
        kind, place = ("pictures", folder) if depths else ("depth", truth)
        raise InputError(f"the drive has no {kind}; expected {place / '*.png'}")
    chosen = frames.of(list(depths), name)  # frames with depth: the first and the last few of a drive have none
    notes: tuple[str, ...] = ()
    missing = [frame for frame in chosen if frame not in pictures]
    gaps = left_out("pictures", missing, len(chosen), "have no picture and are skipped", folder / "*.png")
    chosen = [frame for frame in chosen if frame in pictures]
    taken = [pictures[frame] for frame in chosen]
    maps, read = [depths[frame] for frame in chosen], partial(read_png, per_metre=_PER_METRE)
    depth, more_gaps, more = map_reader("depth", taken, maps, read, truth / "*.png")
    intrinsics = None
    if calibration.is_file():
        intrinsics = np.broadcast_to(_projection(calibration), (len(taken), 3, 3))
    else:
        notes += (f"it has no intrinsics; expected {calibration}",)
    notes = (*notes, *more, "it has no poses")
    return LabelledSequence(name, tuple(taken), depth, intrinsics=intrinsics, notes=notes, left_out=gaps + more_gaps)


def _projection(path: Path) -> Float64[np.ndarray, "3 3"]:
    lines = [line.partition(":") for line in read_text(path).splitlines()]
    values = [value for key, _, value in lines if key.strip() == _PROJECTION]
    try:
        numbers = [float(word) for word in values[0].split()]
        fx, _, cx, _, _, fy, cy = numbers[:7]
    except (IndexError, ValueError):
        raise InputError(f"{path} has no line '{_PROJECTION}: ' with 12 numbers; get it whole") from None
    if len(numbers) != 12:
        raise InputError(f"{path} has {len(numbers)} numbers for {_PROJECTION}; expected 12")
    return intrinsics_matrix(fx, fy, cx, cy, first_pixel=0, source=path)
