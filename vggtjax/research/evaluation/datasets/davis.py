"""DAVIS 2016 and 2017. Does not import jax.

DAVIS 2016 and 2017 at 480p: JPEGImages/480p/<sequence>/%05d.jpg, Annotations/480p/<sequence>/%05d.png. Any label
above 0 is dynamic. https://davischallenge.org/davis2017/code.html.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from vggtjax.clips.captures.files import files
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import pictures_of, subfolders
from vggtjax.research.evaluation.datasets.sequence import (
    FrameChoice,
    LabelledSequence,
    Opener,
    map_reader,
    read_labels,
    unpictured,
)

_RESOLUTION = "480p"  # of DAVIS


def davis(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder that holds JPEGImages and Annotations."""
    folders = subfolders(root / "JPEGImages" / _RESOLUTION)
    if folders:
        return {folder.name: partial(_read_davis, root, folder.name) for folder in folders}
    raise InputError(f"{root} holds no sequence of DAVIS; expected {root / 'JPEGImages' / _RESOLUTION}/SEQUENCE/*.jpg")


def _read_davis(root: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    source, folder = root / "JPEGImages" / _RESOLUTION / name, root / "Annotations" / _RESOLUTION / name
    every, labels = pictures_of(source, ".jpg"), files(folder, ".png")
    pictures = frames.of(every, name)
    paths = [labels.get(path.stem) for path in pictures]
    mask, missing, notes = map_reader("masks", pictures, paths, read_labels, folder / "*.png")
    missing += unpictured(frames, (path.stem for path in every), labels, source)
    return LabelledSequence(name, tuple(pictures), mask=mask, notes=notes, left_out=missing)
