"""Captures of apps and other programs as ground truth: what `vggtjax.clips.captures` reads. Does not import jax."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from vggtjax.clips.captures.capture import Capture
from vggtjax.clips.captures.files import files
from vggtjax.clips.captures.lens import check_no_fisheye
from vggtjax.clips.captures.table import RECORD3D_SUFFIX, capture_kind, read_capture
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import sequence_folders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    at_size,
    left_out,
    unpictured,
)

_OWN_UNIT = "its unit is not the metre, but one of its program's own"  # a note


def captures(root: Path) -> dict[str, Opener]:
    """Find the captures of a folder: the folder itself, or folders and .r3d files in it.

    A file has its name without the suffix, and with it where a folder has that name.
    """
    archives = [path for path in files(root, "").values() if path.suffix.lower() == RECORD3D_SUFFIX]
    if capture_kind(root) is not None:
        archives = []
    found: dict[str, Path] = {}
    try:
        found |= sequence_folders(root, lambda folder: capture_kind(folder) is not None, "a capture")
    except InputError:
        if not archives:
            raise InputError(
                f"{root} holds no capture; expected files of Record3D, Polycam, nerfstudio, COLMAP or TUM in {root} or "
                f"in {root / 'CAPTURE'}, or {root / f'*{RECORD3D_SUFFIX}'}"
            ) from None
    found |= {path.name if path.stem in found else path.stem: path for path in archives}
    return {name: partial(_read, path, name) for name, path in found.items()}


def _read(path: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    whole = read_capture(path, whole=False)
    capture = whole.for_frames(frames.of(whole.frame_names, name))
    check_no_fisheye(capture.lenses, path)
    maps = capture.depth_files or (None,) * len(capture)
    missing = [frame for frame, file in zip(capture.frame_names, maps, strict=True) if file is None]
    notes = capture.notes + (() if capture.metric else (_OWN_UNIT,))
    if len(missing) == len(capture):
        notes += ("it has no depth",)
    return LabelledSequence(
        name,
        capture.pictures,
        None if len(missing) == len(capture) else partial(_depth, capture),
        world_from_camera=capture.world_from_camera,
        intrinsics=capture.intrinsics,
        timestamps=capture.timestamps,
        notes=notes,
        left_out=unpictured(frames, whole.frame_names, whole.absent, "")
        + (() if len(missing) == len(capture) else left_out("depth", missing, len(capture), "have no depth")),
        frame_names=capture.frame_names,
        archive=capture.archive,
    )


def _depth(capture: Capture, frame: int) -> Float32[np.ndarray, "h w"]:
    """Return the depth at the picture's pixels: each takes that of the map's pixel around its centre."""
    width, height = capture.sizes[frame]
    if (depth := capture.depth(frame)) is None:
        return np.zeros((height, width), np.float32)
    return at_size(depth, (height, width))
