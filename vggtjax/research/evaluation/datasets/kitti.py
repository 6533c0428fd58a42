"""KITTI. Does not import jax.

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

from vggtjax.clips.captures.cameras import intrinsics_matrix
from vggtjax.clips.captures.depth_files import read_png
from vggtjax.clips.captures.files import files, read_text
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import subfolders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    left_out,
    map_reader,
)

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
