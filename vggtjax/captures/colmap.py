"""A COLMAP model with its pictures: sparse/0 and images/, as COLMAP, gsplat and nerfstudio lay them out.

Does not import jax.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from vggtjax.captures.cameras import DISTORTED, world_from_camera_of
from vggtjax.captures.capture import Capture, checked_sizes, fitted_intrinsics, left_out, lenses_of, there
from vggtjax.captures.colmap_model import Suffix, read_views
from vggtjax.captures.files import inside
from vggtjax.errors import InputError
from vggtjax.media.images import is_image_name
from vggtjax.media.order import in_order

_MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "distorted/sparse/0")  # places in a folder
_PICTURES = ("images", "../images", "../../images", ".")  # places beside a model's own folder
_FILES = ("cameras", "images")


class _Model(NamedTuple):
    folder: Path
    suffix: Suffix


def find_model(folder: Path) -> _Model | None:
    """Return the model of a folder, or the folder itself where it is one; half a model counts below `sparse`."""
    for place, enough in (*((name, any) for name in _MODELS), (".", all)):
        if place.startswith("colmap") and not (folder / "images").is_dir():
            continue  # a folder of captures, of which one is named colmap
        suffixes: tuple[Suffix, ...] = (".bin", ".txt")
        for complete in (all, enough):
            for suffix in suffixes:
                if complete((folder / place / f"{name}{suffix}").is_file() for name in _FILES):
                    return _Model(folder / place if place != "." else folder, suffix)
    return None


def read_colmap(folder: Path, *, whole: bool = True) -> Capture:
    """Read a folder with a model and its pictures, or the model's own folder with the pictures beside it.

    Pictures that the model did not register are left out.
    """
    if (model := find_model(folder)) is None:
        raise InputError(f"{folder} has no COLMAP model; expected sparse/0 with cameras and images, .bin or .txt")
    source = model.folder / f"images{model.suffix}"
    views = read_views(model.folder, model.suffix)
    if not views:
        raise InputError(f"{source} has no image; expected a model with registered images")
    names = in_order(views, Path)
    place = _pictures(folder, names[0])
    pictures = tuple(inside(place, name, source) for name in names)
    kept = there(pictures, source, whole=whole)
    absent = tuple(picture.stem for number, picture in enumerate(pictures) if number not in kept)
    names, pictures = [names[number] for number in kept], tuple(pictures[number] for number in kept)
    sizes = checked_sizes(pictures, source)
    taken = [views[name] for name in names]
    found = {path for path in place.rglob("*") if is_image_name(path) and not path.name.startswith(".")}
    lost = in_order(found - set(pictures)) if place.name == "images" else []
    missing = left_out([path.stem for path in lost], len(found), "pose")
    return Capture(
        "colmap",
        folder,
        pictures,
        sizes,
        fitted_intrinsics([view.intrinsics for view in taken], [view.size for view in taken], sizes, model.folder),
        world_from_camera_of(np.stack([view.camera_from_world for view in taken]), model.folder),
        lenses=(lenses := lenses_of(view.lens for view in taken)),
        absent=absent,
        left_out=missing,
        notes=missing + (DISTORTED,) * (lenses is not None),
    )


def _pictures(folder: Path, first: str) -> Path:
    """Return the folder of the pictures: the one that has the first name, else the first that is there."""
    root = folder.resolve()
    places = [(root / place).resolve() for place in _PICTURES]
    inside(places[0], first, folder)
    there = [place for place in places if (place / first).is_file()]
    images = [place for place in places if place.name == "images" and place.is_dir()]
    if not there + images:
        raise InputError(f"{folder} has a COLMAP model and no folder images; put the model's pictures there")
    return (there + images)[0]
