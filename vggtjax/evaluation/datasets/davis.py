"""DAVIS 2016 and 2017 at 480p: JPEGImages/480p/<sequence>/%05d.jpg, Annotations/480p/<sequence>/%05d.png.

Any label above 0 is dynamic. https://davischallenge.org/davis2017/code.html. Does not import jax.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from vggtjax.captures.files import files
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.folders import subfolders
from vggtjax.evaluation.datasets.frames import FrameChoice
from vggtjax.evaluation.datasets.maps import mask_reader, read_labels
from vggtjax.evaluation.datasets.sequence import LabelledSequence, Opener

_RESOLUTION = "480p"


def davis(root: Path) -> dict[str, Opener]:
    """Find the sequences of the folder that holds JPEGImages and Annotations."""
    folders = subfolders(root / "JPEGImages" / _RESOLUTION)
    if folders:
        return {folder.name: partial(_read, root, folder.name) for folder in folders}
    raise InputError(f"{root} holds no sequence of DAVIS; expected JPEGImages/{_RESOLUTION} with folders of frames")


def _read(root: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    pictures = frames.of(list(files(root / "JPEGImages" / _RESOLUTION / name, ".jpg").values()), name)
    labels = files(root / "Annotations" / _RESOLUTION / name, ".png")
    mask, notes = mask_reader(pictures, [labels.get(path.stem) for path in pictures], read_labels)
    return LabelledSequence(name, tuple(pictures), mask=mask, notes=notes)
