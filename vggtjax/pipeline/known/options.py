"""What the user knows of a clip's cameras and scale, as options. Does not import jax."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vggtjax.errors import InputError, one_line
from vggtjax.storage.json_values import check_fields
from vggtjax.storage.trajectories import Quaternion

SOURCE = "source"  # in place of a file: what the capture that the clip comes from says
EXIF = "exif"  # in place of a file of intrinsics: what the camera wrote into the pictures, or the video


class Baseline(NamedTuple):
    """The distance between the camera centres of two frames."""

    first: int
    second: int
    metres: float


@dataclass(frozen=True)
class KnownGeometry:
    """Known cameras and lengths. Raises InputError for an invalid value, or for options that exclude each other.

    Attributes:
        intrinsics: known focal lengths and principal point in pixels of the source: four numbers, or a file with a 3 x
            3 matrix or with four numbers or nine a line, for all frames or for each; source: those of the capture's
            folder; exif: the focal length that the camera wrote into the pictures or the video
        shared_focal: one focal length for the whole clip, the median of the predicted ones
        poses: known camera poses, world-from-camera, in OpenCV's axes (x right, y down, z forward): TUM's eight numbers
            a line, KITTI's twelve, or sixteen; source: those of the capture's folder
        quaternion: order of the quaternions in the file of poses: wxyz as MonST3R, CUT3R and VGGT4D write them, or xyzw
            as TUM does; by default what the names of its columns say, or xyzw; required for a file named pred_traj.txt
            without names of columns
        baseline: metric scale: the distance in metres between the cameras of frames I and J, such as 0,7,0.85; I and J
            are counted from 0 among the frames that are taken
        camera_height: metric scale: the mean height of the cameras above the floor, in metres
        known_depths: metric scale: a folder of depth maps, of a depth model or a lidar, named like the frames (.npz,
            .npy or .exr in metres, .png of 16 bits); a CSV file with columns frame (counted from 0 among the frames
            that are taken), x, y and depth, in pixels of the source and metres; source: the depth maps of the capture's
            folder
        depths_per_metre: integer values per metre in depth maps of whole numbers (16-bit .png, integer .npy or .npz);
            1000 by default, which is millimetres
        robust: estimate the scale robustly (Tukey's biweight instead of the median): outliers among the known depths
            get no weight; for maps with many wrong values, such as a third
        leave_out: folder of mask pictures, named as for masks of what moves, white where depth is left out, such as in
            the sky
    """

    intrinsics: str | None = None
    shared_focal: bool = False
    poses: str | None = None
    quaternion: Quaternion | None = None
    baseline: str | None = None
    camera_height: float | None = None
    known_depths: str | None = None
    depths_per_metre: float | None = None
    robust: bool = False
    leave_out: Path | None = None

    def __post_init__(self) -> None:
        if isinstance(self.leave_out, str):
            object.__setattr__(self, "leave_out", Path(self.leave_out))
        check_fields(self)
        if self.intrinsics is not None and self.shared_focal:
            raise InputError("--intrinsics and --shared-focal exclude each other; give one of them")
        if self.quaternion is not None and self.poses in (None, SOURCE):
            raise InputError("--quaternion is of a file of poses; give the file with --poses")
        scales = {
            "--baseline": self.baseline,
            "--camera-height": self.camera_height,
            "--known-depths": self.known_depths,
        }
        given = [flag for flag, value in scales.items() if value is not None]
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)} each set the scale; give one of them")
        if self.known_depths in (None, SOURCE) and self.depths_per_metre is not None:
            raise InputError("--depths-per-metre is of a folder of depth maps; give the folder with --known-depths")
        if self.depths_per_metre is not None and not 0 < self.depths_per_metre < np.inf:
            raise InputError(f"depths_per_metre is {self.depths_per_metre}; expected a number above 0")
        if self.known_depths is None and self.robust:
            raise InputError("--robust is about known depths; give them with --known-depths")
        if self.baseline is not None:
            parse_baseline(self.baseline)
        if self.camera_height is not None and not 0.01 <= self.camera_height <= 10_000:
            raise InputError(f"camera_height is {self.camera_height}; expected 0.01 to 10000 metres")

    def __bool__(self) -> bool:
        """Whether anything is known."""
        return self != KnownGeometry()

    def to_json(self) -> dict[str, Any]:
        """Return what is given, as JSON values."""
        given = {name: value for name, value in asdict(self).items() if value not in (None, False)}
        return given | ({} if self.leave_out is None else {"leave_out": str(self.leave_out)})

    @property
    def from_source(self) -> tuple[str, ...]:
        """The options that the capture's folder answers."""
        return tuple(name for name in ("intrinsics", "poses", "known_depths") if getattr(self, name) == SOURCE)

    def check_many(self) -> None:
        """Raise InputError for what is known of one clip alone: call it where there are many."""
        alone = {
            "--baseline": self.baseline is not None,
            "--leave-out": self.leave_out is not None,
            "--poses with a file": self.poses not in (None, SOURCE),
            "--known-depths with a file": self.known_depths not in (None, SOURCE),
        }
        if given := [name for name, is_given in alone.items() if is_given]:
            raise InputError(f"{given[0]} is of one clip; expected what all clips share, or source")


def parse_baseline(text: str) -> Baseline:
    """Return the frames and the distance of `I,J,METRES`; raises InputError for anything else."""
    words = text.split(",")
    try:
        first, second, metres = int(words[0]), int(words[1]), float(words[2])
    except (IndexError, ValueError):
        first = second = -1
        metres = 0.0
    if len(words) != 3 or min(first, second) < 0 or first == second or not 0 < metres < 1e6:
        raise InputError(
            f"baseline is {one_line(text)!r}; expected I,J,METRES: two different frames, counted from 0, and the "
            "distance between their cameras"
        )
    return Baseline(first, second, metres)
