"""A folder of assets: textures by material, photographs, panoramas, and objects at rest or with a gait.

textures/MATERIAL_*.jpg     square pictures, most of which tile; the name begins with the material
photos/*.jpg                photographs; pano_*.jpg are whole panoramas, 2:1, equirectangular
objects/*.npz               meshes in metres, z up, standing on z = 0: vertices [V, 3], faces [F, 3], uv [V, 2],
                            texture [H, W, 3]; with a gait vertices [T, V, 3], one loop, and fps
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Callable, Iterable
from math import prod
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from vggtjax.clips.media.images import read_image
from vggtjax.errors import InputError, ResultError
from vggtjax.storage.arrays import read_arrays, read_headers
from vggtjax.training.scenes.config import Split
from vggtjax.training.scenes.pyramid import texels

KINDS = ("textures", "photos", "objects")
SIDES = (128, 64, 32, 16, 8)  # pyramid of a tile, finest first
PANORAMA = (192, 384)  # height and width
_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
_TEST = 5  # every fifth file of a material, the photographs, the panoramas and the objects is for test scenes
_GAIT = "anim_"  # begins the names of objects with a gait
_MOST_FILES = 20_000
_FARTHEST, _MOST_REPEATS, _FASTEST = 1000, 10_000, 240  # metres; of a texture; poses a second
_MOST_VALUES = 3_000_000  # of all arrays of one object
# The materials of surfaces, by the first word of a texture's name; a folder without any of a row lends all of its own.
MATERIALS = {
    "road": ("asphalt", "road", "concrete", "paving"),
    "pavement": ("paving", "concrete", "tiles", "terrazzo", "gravel", "cinder"),
    "ground": ("grass", "ground", "gravel", "moss", "sand", "snow", "mud", "rocks"),
    "rock": ("rock", "rocks", "stone", "cinder"),
    "floor": ("wood", "planks", "tiles", "carpet", "marble", "tatami", "floor", "terrazzo", "travertine", "granite"),
    "wall": (
        "bricks",
        "brick",
        "plaster",
        "paint",
        "wall",
        "wallpaper",
        "concrete",
        "stucco",
        "planks",
        "tiles",
        "wood",
    ),
    "ceiling": ("ceiling", "plaster", "paint", "wood", "planks", "office", "concrete"),
    "facade": ("facade", "bricks", "concrete", "stucco", "glazed"),
    "bark": ("bark", "logs", "wood"),
    "leaves": ("moss", "grass", "thatched", "ground"),
    "picture": ("painting", "books", "sign", "photo"),
}


class Tiles(NamedTuple):
    """Square RGB pictures with their pyramids, in one row of texels: level by level, in each level tile by tile."""

    texels: UInt8[np.ndarray, "N 3"]

    @property
    def number(self) -> int:
        """Number of tiles, from the shape."""
        return self.texels.shape[0] // sum(side * side for side in SIDES)


class Shape(NamedTuple):
    """An object: vertices of every pose of its gait (one for things without), faces, texture coordinates, tile."""

    vertices: Float[np.ndarray, "T V 3"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "F 3 2"]
    tile: int
    rate: float  # poses a second; 0 without a gait

    @property
    def extent(self) -> Float[np.ndarray, " 3"]:
        """Size along x, y, z in metres."""
        return np.ptp(self.vertices[0], axis=0)


class Assets(NamedTuple):
    """The files of one split."""

    tiles: Tiles
    materials: dict[str, np.ndarray]  # row of MATERIALS, and "any" -> numbers of tiles
    panoramas: list[UInt8[np.ndarray, "192 384 3"]]
    shapes: dict[str, Shape]


def read_assets(folder: str | Path, split: Split = "training") -> Assets:
    """Return the assets of a split.

    Raises:
        InputError: the folder, or one of the three in it, is missing or holds no files of the split; a texture or
            photograph that is no picture, or an object that is no mesh.
    """
    return _read(Path(folder).resolve(), split)


@functools.lru_cache(maxsize=2)
def _read(folder: Path, split: Split) -> Assets:
    pictures, photos, panoramas, objects = chosen_files(folder, split)
    meshes = {path.stem: read_object(path) for path in objects}
    images = [_square(read_image(path)) for path in (*pictures, *photos)]
    images += [_square(Image.fromarray(mesh["texture"])) for mesh in meshes.values()]
    materials = [*(_material(path) for path in pictures), *("photo" for _ in photos)]
    first = len(materials)
    shapes = {name: _shape(mesh, first + index) for index, (name, mesh) in enumerate(meshes.items())}
    every = np.arange(first)
    rows = {row: np.flatnonzero(np.isin(materials, words)) for row, words in MATERIALS.items()}
    rows = {row: numbers if len(numbers) else every for row, numbers in rows.items()}
    turned = [read_image(path).resize((PANORAMA[1], PANORAMA[0]), Image.Resampling.BICUBIC) for path in panoramas]
    return Assets(make_tiles(images), rows | {"any": every}, [np.asarray(image) for image in turned], shapes)


def chosen_files(folder: Path, split: Split) -> tuple[list[Path], list[Path], list[Path], list[Path]]:
    """Return a split's textures, photographs, panoramas and objects, without reading them.

    Raises InputError where a kind is missing.
    """
    pictures = _of_split(_files(folder / "textures", _SUFFIXES), split, _material, _stem)
    photos = _of_split(_files(folder / "photos", _SUFFIXES), split, lambda _: "", _place)
    panoramas = [path for path in photos if path.name.startswith("pano_")]
    photos = [path for path in photos if not path.name.startswith("pano_")]
    objects = _of_split(_files(folder / "objects", {".npz"}), split, _gait, _model)
    still = [path for path in objects if not path.name.startswith(_GAIT)]
    kinds = ("textures", pictures), ("photos", photos), ("pano_* photos", panoramas), ("objects at rest", still)
    for name, found in kinds:
        if not found:
            raise InputError(
                f"{folder} has no {name} for {split}; expected at least {_TEST} of each kind, and of textures of one "
                "material"
            )
    return pictures, photos, panoramas, objects


def fingerprint(folder: str | Path) -> str:
    """Return a digest of the names and sizes of a folder's assets: another one for other files."""
    names = (path for kind in KINDS for path in _files(Path(folder) / kind, {*_SUFFIXES, ".npz"}))
    rows = [f"{path.parent.name}/{path.name} {path.stat().st_size}" for path in names]
    return hashlib.sha256("\n".join(sorted(rows)).encode()).hexdigest()[:16]


def sample_tiles(
    tiles: Tiles, tile: Int[np.ndarray, " P"], uv: Float[np.ndarray, "P 2"], footprint: Float[np.ndarray, " P"]
) -> Float[np.ndarray, "P 3"]:
    """Return bilinear samples in [0, 1] at positions in units of a tile, which repeats.

    `footprint` is the pixel's size in the same units; it decides the level of the pyramid.
    """
    level = np.clip(np.rint(np.log2(np.maximum(footprint * SIDES[0], 1e-6))), 0, len(SIDES) - 1).astype(np.int32)
    side = SIDES[0] >> level
    starts = np.concatenate([[0], np.cumsum([s * s for s in SIDES])[:-1]]).astype(np.int64) * tiles.number
    start = starts[level] + tile.astype(np.int64) * side * side
    position = np.mod(uv, 1.0) * side[:, None] - 0.5
    low = np.floor(position).astype(np.int32)
    share = (position - low).astype(np.float32)
    x0, y0 = (low % side[:, None]).T
    x1, y1 = ((low + 1) % side[:, None]).T
    fx, fy = share[:, :1], share[:, 1:]
    texels = tiles.texels
    top = texels[start + y0 * side + x0] * (1 - fx) + texels[start + y0 * side + x1] * fx
    bottom = texels[start + y1 * side + x0] * (1 - fx) + texels[start + y1 * side + x1] * fx
    return ((top * (1 - fy) + bottom * fy) / np.float32(255)).astype(np.float32)


def sample_panorama(panorama: UInt8[np.ndarray, "H W 3"], direction: Float[np.ndarray, "P 3"]) -> np.ndarray:
    """Return the colours in [0, 1] that a panorama has in directions, z up: bilinear, [P, 3]."""
    H, W = panorama.shape[:2]
    x, y, z = direction.T
    column = (np.arctan2(y, x) / (2 * np.pi) % 1.0) * W - 0.5
    row = np.clip((0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi) * H - 0.5, 0, H - 1.001)
    left, top = np.floor(column).astype(np.int32), np.floor(row).astype(np.int32)
    fx, fy = (column - left)[:, None].astype(np.float32), (row - top)[:, None].astype(np.float32)
    left, right = left % W, (left + 1) % W
    upper = panorama[top, left] * (1 - fx) + panorama[top, right] * fx
    lower = panorama[top + 1, left] * (1 - fx) + panorama[top + 1, right] * fx
    return ((upper * (1 - fy) + lower * fy) / 255).astype(np.float32)


def _files(folder: Path, suffixes: Iterable[str]) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; expected a folder of assets with textures/, photos/ and objects/")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    if len(files) > _MOST_FILES:
        raise InputError(f"{folder} has {len(files)} files; expected at most {_MOST_FILES}")
    return files


def _of_split(
    files: list[Path], split: Split, group: Callable[[Path], str], member: Callable[[Path], str]
) -> list[Path]:
    """Return every fifth member of each group for test scenes, the others for training."""
    groups: dict[str, dict[str, list[Path]]] = {}
    for path in files:
        groups.setdefault(group(path), {}).setdefault(member(path), []).append(path)
    chosen = (
        path
        for members in groups.values()
        for index, name in enumerate(sorted(members))
        if (index % _TEST == _TEST - 1) == (split == "test")
        for path in members[name]
    )
    return sorted(chosen)


def _place(path: Path) -> str:
    """Return the place that a photograph shows: views and panorama of one place are of one split."""
    return (
        path.stem.removeprefix("pano_") if path.stem.startswith("pano_") else re.sub(r"^hdri_|_\d{3}$", "", path.stem)
    )


def _stem(path: Path) -> str:
    return path.stem


def _model(path: Path) -> str:
    """Return an object without its gait: all gaits of one model are of one split."""
    return path.stem.removesuffix("_" + path.stem.split("_")[-1]) if path.stem.startswith(_GAIT) else path.stem


def _gait(path: Path) -> str:
    return "moves" if path.stem.startswith(_GAIT) else "still"


def _material(path: Path) -> str:
    return path.stem.split("_")[0]


def _square(image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("RGB").resize((SIDES[0], SIDES[0]), Image.Resampling.BICUBIC))


def make_tiles(images: list[np.ndarray]) -> Tiles:
    """Return square pictures of SIDES[0] pixels with their pyramids."""
    return Tiles(texels(images, SIDES))


def read_object(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an object's file. Raises InputError unless they are a mesh."""
    names = ("vertices", "faces", "uv", "texture", "fps")
    try:
        headers = read_headers(path)
        if (count := sum(prod(headers[name].shape) for name in names if name in headers)) > _MOST_VALUES:
            raise InputError(f"{path} holds {count} numbers; expected at most {_MOST_VALUES} in an object")
        mesh = read_arrays(path, names)
    except ResultError as error:
        raise InputError(f"{path}: {error}") from error
    vertices, faces, uv, texture = (mesh.get(name, np.zeros(0)) for name in names[:4])
    moves, rate = path.stem.startswith(_GAIT), mesh.get("fps", np.zeros(0))
    count = vertices.shape[-2] if vertices.ndim == 2 + moves and vertices.size else 0
    fits = vertices.shape[-1:] == (3,) and uv.shape == (count, 2) and faces.ndim == 2 and faces.shape[1:] == (3,)
    fits = fits and vertices.dtype.kind == uv.dtype.kind == "f" and faces.dtype.kind in "iu"
    fits = fits and texture.ndim == 3 and texture.shape[-1] == 3 and texture.dtype == np.uint8 and texture.size > 0
    if not (fits and faces.size and 0 <= faces.min() <= faces.max() < count):
        raise InputError(
            f"{path} is not an object; expected vertices [V, 3] ({_GAIT}*: [T, V, 3]) and uv [V, 2] of floats, faces "
            "[F, 3] of their numbers, and texture [H, W, 3] of bytes"
        )
    if not (np.abs(vertices) < _FARTHEST).all() or not (np.abs(uv) < _MOST_REPEATS).all():
        raise InputError(
            f"{path} has vertices or uv that are not numbers or too large; expected less than {_FARTHEST} metres and "
            f"{_MOST_REPEATS} repetitions"
        )
    if moves and not (rate.shape == () and rate.dtype.kind in "iuf" and 0 < rate <= _FASTEST):
        raise InputError(f"{path} has no fps; expected poses a second of its gait, up to {_FASTEST}")
    return mesh


def _shape(mesh: dict[str, np.ndarray], tile: int) -> Shape:
    vertices = mesh["vertices"].astype(np.float32)
    uv = mesh["uv"].astype(np.float32) * np.asarray([1, -1], np.float32) + np.asarray(
        [0, 1], np.float32
    )  # rows of pictures go down
    rate = float(mesh["fps"]) if vertices.ndim == 3 else 0.0
    faces = mesh["faces"].astype(np.int32)
    return Shape(vertices.reshape(-1, *vertices.shape[-2:]), faces, uv[faces], tile, rate)
