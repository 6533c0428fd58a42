"""The kinds of captures: how each is recognised, and its reader. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import get_args

from vggtjax.clips.captures.capture import Capture, CaptureKind
from vggtjax.clips.captures.colmap import find_model, read_colmap
from vggtjax.clips.captures.nerfstudio import NAMES, read_nerfstudio
from vggtjax.clips.captures.polycam import is_polycam, read_polycam
from vggtjax.clips.captures.record3d import is_record3d, read_record3d
from vggtjax.clips.captures.tum import read_tum
from vggtjax.errors import InputError, check_choice, reading

RECORD3D_SUFFIX = ".r3d"


# Whether a path is of the kind, and its reader. The first that recognises a folder reads it.
KINDS: Mapping[CaptureKind, tuple[Callable[[Path], bool], Callable[..., Capture]]] = {
    "record3d": (lambda path: _is_r3d(path) or is_record3d(path), read_record3d),
    "polycam": (is_polycam, read_polycam),
    "nerfstudio": (lambda path: any((path / name).is_file() for name in NAMES), read_nerfstudio),
    "colmap": (lambda path: find_model(path) is not None, read_colmap),
    "tum": (lambda path: (path / "rgb.txt").exists() and (path / "rgb").exists(), read_tum),
}


def capture_kind(path: str | PathLike[str]) -> CaptureKind | None:
    """Return the kind of a capture by the names of its files, without reading them; None for any other path."""
    path = Path(path)
    with reading(path):
        if not (path.is_dir() or _is_r3d(path)):
            return None
        return next((kind for kind, (recognises, _) in KINDS.items() if recognises(path)), None)


def find_capture(path: str | PathLike[str]) -> Capture | None:
    """Read a capture of a kind that is recognised by its files; None for any other path.

    Raises what `read_capture` raises for a capture that is not whole.
    """
    kind = capture_kind(path)
    return None if kind is None else read_capture(path, kind)


def read_capture(path: str | PathLike[str], kind: CaptureKind | None = None, *, whole: bool = True) -> Capture:
    """Read the pictures, intrinsics, poses and depth of a capture.

    Args:
        path: the capture's folder, or a .r3d file of Record3D.
        kind: "record3d", "polycam", "nerfstudio", "colmap" or "tum"; recognised by the files if None.
        whole: refuse a capture that names pictures or depth maps which are not there; else they are left out, and
            `absent` names the frames without a picture.

    Raises:
        InputError: an unknown kind, a folder of no kind, and files that are missing, invalid or too large.
    """
    if kind is None and (kind := capture_kind(path)) is None:
        raise InputError(
            f"{path} is no capture; expected a folder of Record3D, Polycam, nerfstudio, COLMAP or TUM, or a .r3d file"
        )
    check_choice("kind", kind, get_args(CaptureKind))
    with reading(path):
        return KINDS[kind][1](Path(path), whole=whole)


def _is_r3d(path: Path) -> bool:
    return path.suffix.lower() == RECORD3D_SUFFIX and path.is_file()
