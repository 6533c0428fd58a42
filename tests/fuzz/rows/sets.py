"""Rows of captures, data sets and results of other programs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from tests.captures import folders
from tests.evaluation.datasets.test_dycheck import dycheck_folder
from tests.evaluation.datasets.test_layouts import kitti_folder, sintel_folder
from tests.fuzz import samples
from tests.fuzz.cases import Reader
from tests.fuzz.rows.media import read_frames
from tests.results.test_foreign import QUATERNIONS, WRITERS
from vggtjax.captures.table import read_capture
from vggtjax.clips.images import read_image
from vggtjax.evaluation.datasets import find_sequences
from vggtjax.results.reconstruction import Reconstruction


def _capture(path: Path) -> None:
    capture = read_capture(path)
    for frame in range(min(2, len(capture))):
        capture.depth(frame)
    if capture.frame_names:
        read_frames(path)


def _sequences(name: str, path: Path, **options: Any) -> None:
    for open_sequence in find_sequences(name, path, **options).values():
        sequence = open_sequence()
        for read in (sequence.depth, sequence.mask):
            if read is not None:
                read(0)
        read_image(sequence.pictures[0])


def _sintel(folder: Path) -> Path:
    sintel_folder(folder)
    return folder


def _kitti(folder: Path) -> Path:
    kitti_folder(folder, range(3), range(3))
    return folder


ROWS = (
    # captures
    Reader("capture Record3D", samples.capture(folders.record3d), _capture),
    Reader("capture .r3d", samples.capture(folders.record3d, zipped=True), _capture),
    Reader("capture Record3D export", samples.capture(folders.record3d_export), _capture),
    Reader("capture Polycam", samples.capture(folders.polycam), _capture),
    Reader("capture nerfstudio", samples.capture(folders.nerfstudio), _capture),
    Reader("capture COLMAP", samples.capture(folders.colmap_text), _capture),
    Reader("capture COLMAP, binary", samples.capture(folders.colmap_binary), _capture),
    Reader("capture TUM", samples.capture(folders.tum), _capture),
    # data sets
    Reader("data set plain", samples.plain, partial(_sequences, "plain")),
    Reader("data set tum", samples.tum, partial(_sequences, "tum")),
    Reader("data set bonn", samples.tum, partial(_sequences, "bonn")),
    Reader("data set dycheck", samples.made(partial(dycheck_folder, frames=3)), partial(_sequences, "dycheck")),
    Reader(
        "data set dycheck, lidar",
        samples.made(partial(dycheck_folder, frames=3)),
        partial(_sequences, "dycheck", gt="lidar"),
    ),
    Reader("data set sintel", _sintel, partial(_sequences, "sintel")),
    Reader("data set kitti", _kitti, partial(_sequences, "kitti")),
    Reader("data set davis", samples.davis, partial(_sequences, "davis")),
    Reader("data set 7scenes", samples.seven_scenes, partial(_sequences, "7scenes")),
    # results of other programs
    *(
        Reader(
            f"result of {name}",
            samples.made(writer, "theirs"),
            partial(Reconstruction.load, format=name, quaternion=QUATERNIONS[name]),
        )
        for name, writer in WRITERS.items()
    ),
)
