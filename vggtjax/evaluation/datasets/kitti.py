"""KITTI's annotated depth with the pictures of the raw drives, left colour camera. Does not import jax.

Depth is val/<drive>/proj_depth/groundtruth/image_02/%010d.png, of 16 bits, 256 to the metre, 0 where it is unknown
(the depth benchmark's readme); its pictures are <date>/<drive>/image_02/data or val/<drive>/image_02/data. MonST3R's
gathered folders are read too: image_gathered/<drive>_02 and groundtruth_depth_gathered/<drive>_02. Intrinsics are
P_rect_02 of <date>/calib_cam_to_cam.txt. KITTI does not say from where its pixels count: as in OpenCV, whose
calibration it uses, the centre of the first is taken to be 0. https://www.cvlibs.net/datasets/kitti
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.captures.cameras import intrinsics_matrix
from vggtjax.captures.depth_files import read_png
from vggtjax.captures.files import files, read_text
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.folders import subfolders
from vggtjax.evaluation.datasets.frames import FrameChoice
from vggtjax.evaluation.datasets.maps import depth_reader
from vggtjax.evaluation.datasets.sequence import LabelledSequence, Opener

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
            openers[drive.name] = partial(_read, drive.name, drive / _TRUTH, pictures, date / _CALIBRATION)
    for drive in subfolders(root / _GATHERED):
        name = drive.name.removesuffix("_02")
        if name not in openers:
            pictures = root / "image_gathered" / drive.name
            openers[name] = partial(_read, name, drive, pictures, root / _CALIBRATION)
    if not openers:
        raise InputError(f"{root} holds no drive of KITTI; expected val/<drive>/{_TRUTH} or {_GATHERED}/<drive>_02")
    return openers


def _read(name: str, truth: Path, folder: Path, calibration: Path, frames: FrameChoice) -> LabelledSequence:
    depths, pictures = files(truth, ".png"), files(folder, ".png")
    if not depths or not pictures:
        raise InputError(f"{folder if depths else truth} holds no .png; the drive {name} needs pictures and depth")
    chosen = frames.of(list(depths), name)  # frames with depth: the first and the last few of a drive have none
    notes: tuple[str, ...] = ()
    if missing := [frame for frame in chosen if frame not in pictures]:
        notes += (f"{len(missing)} of {len(chosen)} frames have no picture and are skipped, {missing[0]} first",)
        chosen = [frame for frame in chosen if frame in pictures]
    taken = [pictures[frame] for frame in chosen]
    depth, more = depth_reader(taken, [depths[frame] for frame in chosen], partial(read_png, per_metre=_PER_METRE))
    intrinsics = None
    if calibration.is_file():
        intrinsics = np.broadcast_to(_intrinsics(calibration), (len(taken), 3, 3))
    else:
        notes += (f"it has no {calibration.name}, so no intrinsics",)
    return LabelledSequence(name, tuple(taken), depth, intrinsics=intrinsics, notes=(*notes, *more, "it has no poses"))


def _intrinsics(path: Path) -> Float64[np.ndarray, "3 3"]:
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
