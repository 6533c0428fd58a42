"""SpatialBench: scenes of nineteen data sets in one layout, cut down to the frames that it takes. Does not import jax.

<density>/<data set>/<scene>/ with images/, depths/, poses/ (camera to world, .npy), intrinsics/intrinsic.npy or an
.npy for each frame, meta.json (`depth_format`, `intrinsic_mode`, `tags`), and for some depth_masks/ (0: unknown),
sky_masks/ (bright: sky) and conf_masks/; files of a kind are the frames' in the order of their names. Depth beyond a
limit for each data set is unknown. Pixels count from the centre of the first.
https://github.com/Ropedia/SpatialBench, benchmark/README.md and benchmark/datasets/data_readers.py
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import DISTORTED, PIXEL_CENTRE, checked_intrinsics, checked_world_from_camera
from vggtjax.clips.captures.depth_files import read_exr, read_npy, read_png
from vggtjax.clips.captures.files import files
from vggtjax.clips.captures.pictures import PNG, opening
from vggtjax.clips.media.images import is_image_name
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.folders import sequence_folders
from vggtjax.research.evaluation.datasets.sequence import FrameChoice, LabelledSequence, Maps, Opener
from vggtjax.storage.arrays import read_array
from vggtjax.storage.json_values import read_json

_LEVELS = 5  # density, data set, and up to three of a scene
_SKY = 65500  # values of 16 bits from which depth is sky
_NEAR, _FAR = 0.0015 * 65535, 1000.0  # of OmniWorld's depth
_SURE = 0.5  # of the confidence of depth
_OF_ALL = ("intrinsic.npy", "K_rect.npy", "K_distorted.npy", "distortion_coeffs.npy")  # in intrinsics/, of no frame
_FARTHEST = {
    **dict.fromkeys(("rlbench", "robotwin", "robolab", "dtu"), 3.0),
    **dict.fromkeys(("waymo", "omniworld"), 50.0),
    **dict.fromkeys(("vkitti", "kitti_odometry"), 80.0),
    **dict.fromkeys(("eth3d", "tanks_and_temples"), 30.0),
    **{"droid": 1.0, "tum": 5.0, "ropedia": 8.0, "lingbot": 20.0},
}  # metres
_FARTHEST_OF_OTHERS = 10.0
_DEPTH: dict[str, Callable[[Path], Float32[np.ndarray, "h w"]]] = {
    "uint16_png_div1000": partial(read_png, per_metre=1000.0),
    "uint16_png_div1000_rectified": partial(read_png, per_metre=1000.0),
    "uint16_png_div_655.35": partial(read_png, per_metre=655.35),
    "uint16_png_div100": partial(read_png, per_metre=100.0),
    "uint16_png_inverse_encoded": partial(read_png, per_metre=1.0),
    "npy_float32_meters": read_npy,
    "exr_float32": read_exr,
}
_UNKNOWN: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # pixels without depth, by the folder of their masks
    "depth_masks": lambda values: values == 0,
    "sky_masks": lambda values: values > 0,
    "conf_masks": lambda values: values < _SURE * (255 if values.dtype == np.uint8 else 65535),
}


def spatialbench(root: Path, dynamics: str | None = None) -> dict[str, Opener]:
    """Find the scenes below a folder, or those with the tag `dynamics`: "dynamic" or "static"."""
    folders = sequence_folders(
        root, lambda folder: (folder / "meta.json").is_file() and (folder / "images").is_dir(), "meta.json", _LEVELS
    )
    if dynamics is not None:
        tags = {name: _meta(folder).get("tags") for name, folder in folders.items()}
        folders = {
            name: folder
            for name, folder in folders.items()
            if isinstance(own := tags[name], dict) and own.get("dynamics") == dynamics
        }
        if not folders:
            raise InputError(
                f"none of {len(tags)} scenes below {root} has the tag dynamics: {dynamics} in its meta.json"
            )
    return {name: partial(_read, folder, name) for name, folder in folders.items()}


def _meta(folder: Path) -> dict[str, Any]:
    return read_json(folder / "meta.json", dict[str, Any], "scene")


def _read(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    meta = _meta(folder)
    if meta.get("pyrep_flip"):
        raise InputError(
            f"{folder / 'meta.json'} has pyrep_flip: its pictures are mirrored, which is not undone; leave it out"
        )
    every = sorted(path for path in files(folder / "images", "").values() if is_image_name(path))
    chosen = frames.of(range(len(every)), name, every)
    pictures = [every[place] for place in chosen]

    def of_frames(kind: str, ending: str = "") -> list[Path] | None:
        found = sorted(path for path in files(folder / kind, ending).values() if path.name not in _OF_ALL)
        if found and len(found) != len(every):
            raise InputError(
                f"{folder / kind} has {len(found)} files for {len(every)} pictures; expected equal numbers"
            )
        return [found[place] for place in chosen] if found else None

    shared, kind = folder / "intrinsics" / "intrinsic.npy", str(meta.get("depth_format", "none"))
    matrices = (
        [shared] * len(chosen) if meta.get("intrinsic_mode", "shared") == "shared" else of_frames("intrinsics", ".npy")
    )
    intrinsics = np.stack([_matrix(path, 3)[:3, :3] for path in matrices or ()]) if matrices else None
    if intrinsics is not None:
        intrinsics = checked_intrinsics(intrinsics, folder / "intrinsics")
        intrinsics[:, :2, 2] += PIXEL_CENTRE
    poses, depths = of_frames("poses", ".npy"), of_frames("depths")
    depth = None
    if kind != "none" and depths:
        if kind not in _DEPTH:
            raise InputError(
                f"{folder / 'meta.json'} has depth_format {kind[:60]!r}; expected one of {', '.join(_DEPTH)}"
            )
        hidden = {what: of_frames(what, ".png") for what in _UNKNOWN}
        farthest = next((_FARTHEST[part] for part in folder.parts if part in _FARTHEST), _FARTHEST_OF_OTHERS)
        masks = {path: {k: v[i] for k, v in hidden.items() if v} for i, path in enumerate(depths)}
        depth = Maps(pictures, depths, lambda path: _depth(path, kind, meta, masks[path], farthest), is_depth=True)
    missing = {"depth": depth, "poses": poses, "intrinsics": intrinsics}
    notes = tuple(f"it has no {what}" for what, there in missing.items() if there is None)
    return LabelledSequence(
        name,
        tuple(pictures),
        depth,
        world_from_camera=None
        if poses is None
        else checked_world_from_camera(np.stack([_pose(p) for p in poses]), folder),
        intrinsics=intrinsics,
        notes=notes + (DISTORTED,) * (meta.get("image_state") == "distorted_original"),
    )


def _matrix(path: Path, rows: int) -> Float64[np.ndarray, "R C"]:
    values = read_array(path)
    if values.ndim != 2 or min(values.shape) < rows or max(values.shape) > 4 or values.dtype.kind != "f":
        raise InputError(f"{path} has shape {values.shape} of {values.dtype}; expected a matrix of {rows} rows")
    return values.astype(np.float64)


def _pose(path: Path) -> Float64[np.ndarray, "4 4"]:
    return np.concatenate([_matrix(path, 3)[:3], [[0, 0, 0, 1]]])


def _depth(
    path: Path, kind: str, meta: dict[str, Any], masks: dict[str, Path], farthest: float
) -> Float32[np.ndarray, "h w"]:
    depth = _DEPTH[kind](path)
    if kind == "uint16_png_div100":
        depth[depth * 100 >= _SKY] = 0
    if kind == "uint16_png_inverse_encoded":
        share = depth / 65535
        metres = share / (_FAR - share * (_FAR - 1)) / 0.004 * float(meta.get("metric_scale", 1))
        depth = np.where((depth < _NEAR) | (depth > _SKY), 0, metres).astype(np.float32)
    for what, mask in masks.items():
        with opening(mask, PNG) as image:
            values = np.asarray(image)
        if values.shape == depth.shape:
            depth = np.where(_UNKNOWN[what](values), 0, depth)
    return np.where(depth > farthest, 0, depth).astype(np.float32)
