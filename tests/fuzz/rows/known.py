"""Rows of lists of clips, of what is known of a clip, and of depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.dataset_files import dpt, npy
from tests.fuzz import samples
from tests.fuzz.cases import Reader
from tests.fuzz.samples import clip
from vggtjax.captures.depth_files import read_dpt, read_exr, read_npy, read_png
from vggtjax.clips.queries import parse_queries
from vggtjax.clips.sources import clips_by_name, open_source
from vggtjax.known.depths import read_depths
from vggtjax.known.intrinsics import at_clip_pixels, read_intrinsics
from vggtjax.known.poses import checked_known_poses, read_poses

_POSES = "".join(f"{number} {number} {number % 2} 0 0 0 0 1\n" for number in range(3))


def _clips(path: Path) -> None:
    for source in clips_by_name([str(path)]).values():
        open_source(source)


def _exr(folder: Path) -> Path:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": np.ones((8, 12), np.float32)}).write(str(folder / "depth.exr"))
    return folder / "depth.exr"


ROWS = (
    # lists and what is known
    Reader("list of clips .csv", samples.manifest("clips.csv"), _clips),
    Reader("list of clips .jsonl", samples.manifest("clips.jsonl"), _clips),
    Reader("list of clips .parquet", samples.manifest("clips.parquet"), _clips),
    Reader(
        "points",
        samples.text_file("points.csv", "x,y,frame\n3,4,0\n5.5,6,1\n"),
        lambda path: parse_queries(str(path), clip()),
    ),
    Reader(
        "depths",
        samples.text_file("depths.csv", "frame,x,y,depth\n0,3,4,2.5\n1,5,6,3\n"),
        lambda path: read_depths(path, clip()),
    ),
    Reader(
        "poses",
        samples.text_file("poses.txt", _POSES),
        lambda path: checked_known_poses(read_poses(path, clip()), 3, str(path)),
    ),
    Reader(
        "intrinsics",
        samples.text_file("K.txt", "30 30 14 14\n"),
        lambda path: at_clip_pixels(read_intrinsics(str(path)), clip(), "intrinsics"),
    ),
    # depth maps
    Reader(
        "depth .png",
        samples.text_file("depth.png", samples.depth_png([[1000, 0, 2000]] * 4)),
        lambda path: read_png(path, 1000.0),
    ),
    Reader("depth .dpt", samples.text_file("depth.dpt", dpt(np.ones((6, 8)))), read_dpt),
    Reader("depth .npy", samples.text_file("depth.npy", npy(np.ones((6, 8, 1), np.float32))), read_npy),
    Reader("depth .exr", _exr, read_exr),
)
