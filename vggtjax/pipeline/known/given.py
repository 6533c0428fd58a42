"""What the options name, read and checked against a clip before any long work. Does not import jax."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64

from vggtjax.clips.captures.capture import Capture
from vggtjax.clips.clip import Clip
from vggtjax.errors import InputError
from vggtjax.pipeline.known.depth_maps import depth_files, read_depth_maps
from vggtjax.pipeline.known.depths import MOST_FILE_BYTES, DepthSamples, check_depths, read_depths
from vggtjax.pipeline.known.intrinsics import at_clip_pixels, read_intrinsics
from vggtjax.pipeline.known.options import EXIF, SOURCE, Baseline, KnownGeometry, parse_baseline
from vggtjax.pipeline.known.poses import checked_known_poses, pose_table, read_poses
from vggtjax.pipeline.known.stated import stated_intrinsics
from vggtjax.results.result import Result
from vggtjax.storage.csv_file import read_csv


class Given(NamedTuple):
    """Known cameras and lengths of a clip of S frames, as far as they are given."""

    options: KnownGeometry
    intrinsics: Float64[np.ndarray, "S 3 3"] | None = None  # pixels of the clip
    poses: Float64[np.ndarray, "S 4 4"] | None = None  # world-from-camera
    poses_name: str = ""  # where the poses come from
    baseline: Baseline | None = None
    depths: DepthSamples | None = None  # of a file
    depth_maps: Float32[np.ndarray, "S H W"] | None = None  # of a folder: metres, 0 where it is unknown
    leave_out: Bool[np.ndarray, "S H W"] | None = None
    capture: Capture | None = None  # of the clip's frames, where an option asks for it


def check_readable(known: KnownGeometry) -> None:
    """Raise InputError or ResultError for files that are missing or unreadable: call it before long work."""
    for name in ("poses", "known_depths"):
        path = getattr(known, name)
        if path not in (None, SOURCE) and not os.path.lexists(path):
            flag = f"--{name.replace('_', '-')}"
            kinds = "a file, a folder" if name == "known_depths" else "a file"
            raise InputError(f"{flag} is {str(path)!r}, and there is no such file; expected {kinds} or {SOURCE!r}")
    if known.intrinsics not in (None, SOURCE, EXIF):
        read_intrinsics(known.intrinsics)
    if known.poses not in (None, SOURCE):
        pose_table(known.poses, known.quaternion)
    if known.known_depths not in (None, SOURCE):
        if os.path.isdir(known.known_depths):  # noqa: PTH112 - False for an over-long name
            depth_files(Path(known.known_depths))
        else:
            read_csv(Path(known.known_depths), most_bytes=MOST_FILE_BYTES)
    if known.leave_out is not None and not os.path.isdir(known.leave_out):  # noqa: PTH112 - False for an over-long name
        raise InputError(f"leave_out is {str(known.leave_out)!r}; expected a folder of pictures")


def read_known(
    known: KnownGeometry,
    frames: Clip | Result,
    *,
    leave_out: Bool[np.ndarray, "S H W"] | None = None,
    capture: Capture | None = None,
) -> Given:
    """Read what the options name, and check it against the frames.

    Args:
        known: the options; the folder of masks is not read here.
        frames: the clip, or its result.
        leave_out: pixels without depth.
        capture: that the clip comes from, if it does.

    Raises:
        InputError: values that do not fit the clip, and "source" without a capture, or with one that lacks them.
    """
    count = len(frames.images)
    boxes = [(slice(top, bottom), slice(left, right)) for left, top, right, bottom in frames.valid_box.tolist()]
    if leave_out is not None and all(mask[box].all() for mask, box in zip(leave_out, boxes, strict=True)):
        raise InputError("leave_out covers every pixel; expected pictures that are bright where depth is left out")
    if not known.from_source:
        capture = None
    elif capture is None:
        raise InputError(
            f"{' and '.join(known.from_source)} shall come from the source, and the clip's source is no capture; "
            "expected a folder of COLMAP, nerfstudio, Record3D, Polycam or TUM"
        )
    else:
        capture = capture.for_frames(frames.frame_names)
    intrinsics = poses = baseline = depths = maps = None
    poses_name = ""
    if known.intrinsics is not None:
        intrinsics = at_clip_pixels(_matrices(known.intrinsics, frames, capture), frames, "intrinsics")
    if known.poses is not None:
        from_source = known.poses == SOURCE
        poses = (
            _recorded(capture, "world_from_camera")
            if from_source
            else read_poses(known.poses, frames, known.quaternion)
        )
        poses_name = str(capture.path) if from_source and capture is not None else known.poses
        poses = checked_known_poses(poses, count, poses_name)
    if known.baseline is not None:
        baseline = parse_baseline(known.baseline)
        if max(baseline.first, baseline.second) >= count:
            raise InputError(
                f"baseline names frames {baseline.first} and {baseline.second}; expected frames 0 to {count - 1}"
            )
    if known.known_depths == SOURCE and capture is not None:
        check_depths(capture)
    elif known.known_depths is not None and os.path.isdir(known.known_depths):  # noqa: PTH112
        maps = read_depth_maps(Path(known.known_depths), frames, known.depths_per_metre)
    elif known.known_depths is not None and known.depths_per_metre is not None:
        raise InputError(
            f"--depths-per-metre is of a folder of depth maps, and {known.known_depths} is a file; leave it out, as "
            "depths of a CSV file are metres"
        )
    elif known.known_depths is not None:
        depths = read_depths(known.known_depths, frames)
    return Given(known, intrinsics, poses, poses_name, baseline, depths, maps, leave_out, capture)


def _matrices(text: str, frames: Clip | Result, capture: Capture | None) -> Float64[np.ndarray, "F 3 3"]:
    """Return the intrinsics that the option names, in pixels of the source."""
    if text == EXIF:
        if not isinstance(frames, Clip):
            raise InputError(
                "intrinsics is 'exif', and a result has no files; expected a clip that was loaded from files"
            )
        return stated_intrinsics(frames)
    return _recorded(capture, "intrinsics") if text == SOURCE else read_intrinsics(text)


def _recorded(capture: Capture | None, name: str) -> Float64[np.ndarray, "S n n"]:
    values = getattr(capture, name)
    if values is None:
        words = {"intrinsics": "intrinsics", "world_from_camera": "poses"}
        path = "" if capture is None else capture.path
        raise InputError(f"{path} has no {words[name]}; give them as a file, or leave the option out")
    return values
