"""Data sets of moving objects with masks: FBMS-59 and SegTrack v2. Does not import jax.

FBMS-59 (https://lmb.informatik.uni-freiburg.de/resources/datasets): Testset/<sequence>/*.jpg, or .ppm in the older
BMS-26, and of some frames GroundTruth/*.ppm or *.pgm, which GroundTruth/<sequence>Def.dat lists: after "Total number
of regions:" the value of each region, the background first, and for each labelled frame "Frame number:", counted from
0, and "File name:". The value of a .ppm's pixel is 65536 R + 256 G + B. Values that are not listed are background, as
in the benchmark's own program. Every other region moves somewhere in the shot.

SegTrack v2 (https://web.engr.oregonstate.edu/~lif/SegTrack2/dataset.html): JPEGImages/<sequence>/* and, of the same
names, GroundTruth/<sequence>/* or a folder for each object, GroundTruth/<sequence>/<object>/*; objects are bright.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from vggtjax.clips.captures.files import files, inside, read_text
from vggtjax.clips.captures.pictures import opening
from vggtjax.clips.masks import read_mask
from vggtjax.clips.media.images import is_image_name
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import sequence_folders, subfolders
from vggtjax.research.evaluation.datasets.sequence import FrameChoice, LabelledSequence, Maps, Opener, left_out

_TRUTH = "GroundTruth"


def fbms(root: Path) -> dict[str, Opener]:
    """Find the sequences of a folder such as Testset, or of a folder of such folders."""
    folders = sequence_folders(
        root, lambda folder: any((folder / _TRUTH).glob("*.dat")), f"{_TRUTH}/SEQUENCEDef.dat", levels=2
    )
    return {name: partial(_read_fbms, folder, name) for name, folder in folders.items()}


def _read_fbms(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    every, pictures = _pictures(folder, frames, name)
    objects, labelled = _definition(next((folder / _TRUTH).glob("*.dat")), len(every))
    order = {path: number for number, path in enumerate(every)}
    paths = [labelled.get(order[path]) for path in pictures]
    unlabelled = [path.stem for path, label in zip(pictures, paths, strict=True) if label is None]
    if len(unlabelled) == len(pictures):
        raise InputError(f"none of {len(pictures)} frames of sequence {name} has labels; take more of its frames")
    return LabelledSequence(
        name,
        tuple(pictures),
        mask=Maps(pictures, paths, partial(_regions, objects=objects)),
        left_out=left_out("masks", unlabelled, len(pictures), "have no labels, as the data set has it", usual=True),
    )


def _definition(path: Path, count: int) -> tuple[list[int], dict[int, Path]]:
    """Return the values of the regions but the background's, and the files of labels by the numbers of frames."""
    text = read_text(path)
    try:
        regions, *rest = text.partition("Total number of regions:")[2].split()
        values = [int(word) for word in rest[: int(regions)]]
        listed = re.findall(r"Frame number:\s+(\d+)\s+File name:\s+(\S+)", text)
    except ValueError:
        values, listed = [], []
    if len(values) < 2 or not listed:
        raise InputError(f"{path} names no regions or no frames; expected a ground truth definition file of FBMS-59")
    if beyond := [frame for frame, _ in listed if int(frame) >= count]:
        raise InputError(f"{path} has labels of frame {beyond[0]}; the sequence has {count} frames: get it whole")
    return values[1:], {int(frame): inside(path.parent, file, path) for frame, file in listed}


def _regions(path: Path, objects: list[int]) -> Bool[np.ndarray, "h w"]:
    with opening(path, ("PPM",)) as image:
        values = np.asarray(image).astype(np.int64)
    return np.isin(values @ [65536, 256, 1] if values.ndim == 3 else values, objects)


def segtrack(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder that holds JPEGImages and GroundTruth."""
    if folders := subfolders(root / "JPEGImages"):
        return {folder.name: partial(_read_segtrack, root, folder) for folder in folders}
    raise InputError(f"{root} holds no sequence of SegTrack v2; expected {root / 'JPEGImages' / 'SEQUENCE' / '*.png'}")


def _read_segtrack(root: Path, folder: Path, frames: FrameChoice) -> LabelledSequence:
    _, pictures = _pictures(folder, frames, folder.name)
    truth = root / _TRUTH / folder.name
    objects = [{path.stem: path for path in files(each, "").values()} for each in subfolders(truth) or [truth]]
    if missing := [path.stem for path in pictures if not all(path.stem in labels for labels in objects)]:
        raise InputError(f"frame {missing[0]} of sequence {folder.name} has no labels; expected them in {truth}")

    def read(path: Path) -> Bool[np.ndarray, "h w"]:
        return np.logical_or.reduce([read_mask(labels[path.stem]) for labels in objects])

    return LabelledSequence(folder.name, tuple(pictures), mask=Maps(pictures, pictures, read))


def _pictures(folder: Path, frames: FrameChoice, name: str) -> tuple[list[Path], list[Path]]:
    every = [path for path in files(folder, "").values() if is_image_name(path)]
    if not every:
        raise InputError(f"the sequence has no pictures; expected {folder / '*.jpg'}")
    return every, frames.of(every, name)
