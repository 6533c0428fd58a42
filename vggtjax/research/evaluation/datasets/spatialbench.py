"""SpatialBench: scenes of nineteen data sets in one layout, cut down to the frames that it takes. Does not import jax.

<density>/<data set>/<scene>/ with images/, depths/, poses/ (camera to world, .npy), intrinsics/intrinsic.npy or an
.npy for each frame, meta.json (`depth_format`, `intrinsic_mode`, `tags`), and for some depth_masks/ (0: unknown),
sky_masks/ (bright: sky) and conf_masks/; files of a kind are the frames' in the order of their names. Depth beyond a
limit for each data set is unknown. Pixels count from the centre of the first.
https://github.com/Ropedia/SpatialBench, benchmark/README.md and benchmark/datasets/data_readers.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
_OF_ALL = ("intrinsic.npy", "K_rect.npy", "K_distorted.npy", "distortion_coeffs.npy")  # in intrinsics/, of no frame
_SKY = 65500  # values of 16 bits from which depth is sky
_NEAR, _FAR, _UNIT = 98, 1000.0, 250.0  # of OmniWorld's encoded depth: its least value, its range, metres
_FARTHEST = {  # metres; 10 for others
    **dict.fromkeys(("rlbench", "robotwin", "robolab", "dtu"), 3.0),
    **dict.fromkeys(("waymo", "omniworld"), 50.0),
    **dict.fromkeys(("vkitti", "kitti_odometry"), 80.0),
    **dict.fromkeys(("eth3d", "tanks_and_temples"), 30.0),
    **{"droid": 1.0, "tum": 5.0, "ropedia": 8.0, "lingbot": 20.0},
}
_UNKNOWN: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # pixels without depth, by the folder of their masks
    "depth_masks": lambda values: values == 0,
    "sky_masks": lambda values: values > 0,
    "conf_masks": lambda values: values < np.iinfo(values.dtype).max / 2,
}


def _inverse(path: Path) -> Float32[np.ndarray, "h w"]:
    values = read_png(path, per_metre=1.0)
    share = values / 65535
    return np.where((values > _NEAR) & (values <= _SKY), _UNIT * share / (_FAR - share * (_FAR - 1)), 0)


def _below_sky(path: Path) -> Float32[np.ndarray, "h w"]:
    metres = read_png(path, per_metre=100.0)
    return np.where(metres < _SKY / 100, metres, 0)


_DEPTH: dict[str, Callable[[Path], Float32[np.ndarray, "h w"]]] = {  # by depth_format
    "uint16_png_div1000": partial(read_png, per_metre=1000.0),
    "uint16_png_div1000_rectified": partial(read_png, per_metre=1000.0),
    "uint16_png_div_655.35": partial(read_png, per_metre=655.35),
    "uint16_png_div100": _below_sky,
    "uint16_png_inverse_encoded": _inverse,
    "npy_float32_meters": read_npy,
    "exr_float32": read_exr,
}


def spatialbench(root: Path, dynamics: str | None = None) -> dict[str, Opener]:
    """Find the scenes below a folder, or those with the tag `dynamics`: "dynamic" or "static"."""
    folders = sequence_folders(root, lambda folder: (folder / "meta.json").is_file(), "meta.json", _LEVELS)
    tagged = {name: folder for name, folder in folders.items() if dynamics in (None, _dynamics(folder))}
    if not tagged:
        raise InputError(
            f"none of {len(folders)} scenes below {root} has the tag dynamics: {dynamics} in its meta.json"
        )
    return {name: partial(_read, folder, name) for name, folder in tagged.items()}


def _meta(folder: Path) -> dict[str, Any]:
    return read_json(folder / "meta.json", dict[str, Any], "scene")


def _dynamics(folder: Path) -> object:
    tags = _meta(folder).get("tags")
    return tags.get("dynamics") if isinstance(tags, dict) else None


def _read(folder: Path, name: str, frames: FrameChoice) -> LabelledSequence:
    meta = _meta(folder)
    kind, scale = str(meta.get("depth_format", "none")), meta.get("metric_scale", 1)
    if kind not in (*_DEPTH, "none"):
        raise InputError(f"{folder} has depth_format {kind[:60]!r}; expected one of {', '.join(_DEPTH)}: leave it out")
    if not isinstance(scale, int | float):
        raise InputError(f"{folder} has metric_scale {scale!r:.40}; expected a number")
    if meta.get("pyrep_flip"):
        raise InputError(f"{folder} has pyrep_flip: its pictures are mirrored, which is not undone here; leave it out")
    every = sorted(path for path in files(folder / "images", "").values() if is_image_name(path))
    chosen = frames.of(range(len(every)), name, every)

    def of_frames(what: str) -> list[Path]:
        found = sorted(path for path in files(folder / what, "").values() if path.name not in _OF_ALL)
        if len(found) not in (0, len(every)):
            raise InputError(
                f"{folder / what} has {len(found)} files for {len(every)} pictures; expected equal numbers"
            )
        return [found[place] for place in chosen] if found else []

    is_shared = meta.get("intrinsic_mode", "shared") == "shared"
    matrices = [folder / "intrinsics" / _OF_ALL[0]] * len(chosen) if is_shared else of_frames("intrinsics")
    intrinsics, poses = _matrices(matrices, 3), _matrices(of_frames("poses"), 4)
    if intrinsics is not None:
        intrinsics = checked_intrinsics(intrinsics[:, :, :3], folder)
        intrinsics[:, :2, 2] += PIXEL_CENTRE
    if poses is not None:
        bottom = np.tile([0.0, 0, 0, 1], (len(poses), 1, 1))
        poses = checked_world_from_camera(np.concatenate([poses, bottom], axis=1), folder)
    depths, pictures = of_frames("depths") if kind in _DEPTH else [], [every[place] for place in chosen]
    hidden = {what: dict(zip(depths, of_frames(what), strict=False)) for what in _UNKNOWN}
    farthest = next((_FARTHEST[part] for part in reversed(folder.parts) if part in _FARTHEST), 10.0)

    def depth(path: Path) -> Float32[np.ndarray, "h w"]:
        metres = _DEPTH[kind](path) * np.float32(scale if kind.endswith("inverse_encoded") else 1)
        for what, masks in hidden.items():
            if path in masks:
                with opening(masks[path], PNG) as image:
                    values = np.asarray(image)
                metres = np.where(_UNKNOWN[what](values), 0, metres) if values.shape == metres.shape else metres
        return np.where(metres > farthest, 0, metres).astype(np.float32)

    there: dict[str, Any] = {"depth": Maps(pictures, depths, depth, is_depth=True) if depths else None, "poses": poses}
    return LabelledSequence(
        name,
        tuple(pictures),
        there["depth"],
        world_from_camera=poses,
        intrinsics=intrinsics,
        notes=tuple(f"it has no {what}" for what, known in there.items() if known is None)
        + (DISTORTED,) * (meta.get("image_state") == "distorted_original"),
    )


def _matrices(paths: Sequence[Path], columns: int) -> Float64[np.ndarray, "S 3 C"] | None:
    """Return the first three rows of matrices, None of no file."""
    values = [read_array(path) for path in paths]
    for path, matrix in zip(paths, values, strict=True):
        if matrix.shape not in ((3, columns), (4, 4)) or matrix.dtype.kind != "f" or matrix.shape != values[0].shape:
            raise InputError(
                f"{path} has shape {matrix.shape} of {matrix.dtype}; expected (3, {columns}) for each frame"
            )
    return np.stack(values)[:, :3].astype(np.float64) if values else None
