"""A COLMAP model with its pictures: sparse/0 and images/, as COLMAP, gsplat and nerfstudio lay them out.

Does not import jax.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vggtjax.clips.captures.cameras import DISTORTED, world_from_camera_of
from vggtjax.clips.captures.capture import Capture, checked_sizes, fitted_intrinsics, left_out, lenses_of, there
from vggtjax.clips.captures.colmap_model import ColmapView, Suffix, count_points, read_views
from vggtjax.clips.captures.files import inside
from vggtjax.clips.media.images import is_image_name
from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError, one_line

_PLACES = ("sparse", "colmap/sparse", "distorted/sparse")  # of models in a folder: one, or numbered ones
_PICTURES = ("images", "../images", "../../images", ".")  # places beside a model's own folder
_FILES = ("cameras", "images")


class _Model(NamedTuple):
    folder: Path
    suffix: Suffix


def find_model(folder: Path) -> _Model | None:
    """Return the first model of a folder, or the folder itself where it is one; half a model counts below `sparse`."""
    return next(iter(_models(folder)), None)


def _models(folder: Path) -> list[_Model]:
    """Return the models of one place: those with a number in its order, then the one that has none.

    COLMAP numbers the parts of a reconstruction that it could not join. Where no model is whole, half ones count.
    """
    for place in _PLACES:
        if place.startswith("colmap") and not (folder / "images").is_dir():
            continue  # a folder of captures, of which one is named colmap
        root = folder / place
        if not root.is_dir():
            continue
        parts = in_order([path for path in root.iterdir() if path.name.isdecimal() and path.is_dir()], Path)
        for enough in (all, any):
            if found := [model for path in (*parts, root) if (model := _model_in(path, enough))]:
                return found
    own = _model_in(folder, all)
    return [] if own is None else [own]


def _model_in(folder: Path, enough: Callable[[Iterable[bool]], bool]) -> _Model | None:
    suffixes: tuple[Suffix, ...] = (".bin", ".txt")
    for complete in (all, enough):
        for suffix in suffixes:
            if complete((folder / f"{name}{suffix}").is_file() for name in _FILES):
                return _Model(folder, suffix)
    return None


def _chosen(folder: Path) -> tuple[_Model, Mapping[str, ColmapView], tuple[str, ...]]:
    """Return the model with the most pictures that are there, its views, and a note on the others.

    Where several have as many, the one with the most points is taken, then the first. A model that cannot be read does
    not count beside others.
    """
    models = _models(folder)
    if not models:
        raise InputError(f"{folder} has no COLMAP model; expected sparse/0 with cameras and images, .bin or .txt")
    if len(models) == 1:
        return models[0], read_views(*models[0]), ()
    ranks, counts, problems = [], [], []
    places = _places(folder)
    for number, model in enumerate(models):
        name = model.folder.relative_to(folder).as_posix()
        try:
            views = read_views(*model)
            pictures = sum(any(inside(place, view, folder).is_file() for place in places) for view in views)
            points = count_points(model.folder / f"points3D{model.suffix}")
        except InputError as error:
            problems.append(error)
            counts.append(f"{name} cannot be read")
            continue
        ranks.append((pictures, points, -number, model, views, name))
        counts.append(f"{name} has {pictures} pictures and {points} points")
    if not ranks:
        raise problems[0]
    *_, model, views, name = max(ranks, key=lambda rank: rank[:3])
    said = f"of {len(models)} COLMAP models {name} is read, which has the most pictures or points: {', '.join(counts)}"
    return model, views, (one_line(said),)


def read_colmap(folder: Path, *, whole: bool = True) -> Capture:
    """Read a folder with a model and its pictures, or the model's own folder with the pictures beside it.

    Of several models the one with the most pictures is read. Pictures that it did not register are left out.
    """
    model, views, note = _chosen(folder)
    source = model.folder / f"images{model.suffix}"
    if not views:
        raise InputError(f"{source} has no image; expected a model with registered images")
    names = in_order(views, Path)
    place = _pictures(folder, names[0])
    pictures = tuple(inside(place, name, source) for name in names)
    kept, absent = there(pictures, source, whole=whole)
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
        left_out=note + missing,
        notes=note + missing + (DISTORTED,) * (lenses is not None),
    )


def _places(folder: Path) -> list[Path]:
    root = folder.resolve()
    return [(root / place).resolve() for place in _PICTURES]


def _pictures(folder: Path, first: str) -> Path:
    """Return the folder of the pictures: the one that has the first name, else the first that is there."""
    places = _places(folder)
    inside(places[0], first, folder)
    having = [place for place in places if (place / first).is_file()]
    images = [place for place in places if place.name == "images" and place.is_dir()]
    if not having + images:
        raise InputError(f"{folder} has a COLMAP model and no folder images; put the model's pictures there")
    return (having + images)[0]
