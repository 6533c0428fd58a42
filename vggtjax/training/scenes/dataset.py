"""Write generated scenes as a data set.

In the folder:

    index.json              conventions, files, settings, and the complete scenes
    preview.png             an overview of some scenes
    scene_0000/             a scene, renamed into place when complete: `FILES`, named by frame number
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from vggtjax.cameras import world_from_camera
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.errors import InputError, OutputError, check_choice, one_line
from vggtjax.progress import Progress, no_progress
from vggtjax.results.export import encode_depth, write_intrinsics
from vggtjax.storage.json_values import read_json, without_defaults
from vggtjax.storage.trajectories import write_trajectory
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.scenes.held_out import Kind
from vggtjax.training.scenes.render import SyntheticClip, generate
from vggtjax.training.scenes.sheet import draw_sheet
from vggtjax.training.scenes.textures import Split, load_textures

INDEX, PREVIEW = "index.json", "preview.png"
_MOST_SCENES = 10_000
_FORMAT_VERSION = 1
MARKS = {"format": "vggtjax scenes", "version": _FORMAT_VERSION}  # of an index
_LATER = {"pitch": [0.0, 0.0], "roll": 0.0}  # as in sets before these fields
_STREAM = 0x73657473  # folded into the seed's key, so that no other use of a seed draws these scenes
_MILLIMETRES = 1000.0
_MOST_DEPTH = 65.5  # metres that 16 bits hold in millimetres
_PNG_LEVEL = 3  # zlib's; higher ones take several times as long for a few percent
_WORKERS = 8
_INDEX_BYTES = 2**22

CONVENTIONS = {
    "units": "metres",
    "camera": "OpenCV: x right, y down, z forward; intrinsics in pixels, principal point at the image centre",
    "pixels": "the centre of the first pixel is at (0.5, 0.5); truth is that of the pixel's centre",
    "world": "axes of the scene, y down; the room is at rest in it",
    "parts": "0 is the room; every rigid part has a number, and every pixel shows one",
}
FILES = {
    "images/*.png": "RGB, 8 bits",
    "depth/*.npy": "float32 [H, W], metres along z",
    "depth/*.png": "uint16, the same in millimetres, 0 from 65.5 metres on",
    "mask/*.png": "uint8, 255 on parts that move in the clip, else 0; shadows do not count",
    "parts/*.png": "uint8, number of the part",
    "flow/*.npy": "float32 [H, W, 3], world axes: where the pixel's point is a frame later, minus where it is",
    "part_poses.npy": "float32 [S, K, 3, 4], world from part by number: "
    "a point X of part k at frame s is at P[t, k] inverse(P[s, k]) X at frame t",
    "trajectory.txt": "frame tx ty tz qx qy qz qw, world from camera (TUM format)",
    "intrinsics.txt": "fx fy cx cy of every frame",
}

_draw = jax.jit(generate, static_argnums=2)


class SceneFiles(NamedTuple):
    """What the folder of a scene holds. Metres; depth is 0 in the sky."""

    images: UInt8[np.ndarray, "S H W 3"]
    depth: Float[np.ndarray, "S H W"]
    dynamic_mask: Bool[np.ndarray, "S H W"]
    parts: UInt8[np.ndarray, "S H W"]
    scene_flow: Float[np.ndarray, "S H W 3"]
    camera_from_world: Float[np.ndarray, "S 3 4"]
    intrinsics: Float[np.ndarray, "S 3 3"]
    world_from_part: Float[np.ndarray, "S K 3 4"] | None  # None where parts are not rigid


def write_scenes(
    out: str | Path,
    config: SceneConfig,
    *,
    count: int,
    kind: Kind = "dynamic",
    split: Split = "training",
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """Generate scenes into a folder; existing scenes are kept, so the same call resumes an interrupted set.

    A scene depends on the settings and on its number, not on `count`.

    Args:
        out: folder of the set, made if missing.
        config: size, frames and rendering. `kind` replaces its `dynamic`.
        count: number of scenes, at most 10 000.
        kind: "static", or "dynamic" where one to three objects move, not always in view.
        split: of the textures.
        seed: different seeds share no scene.
        progress: called with the number of complete scenes and `count`.

    Returns:
        The folders of the scenes.

    Raises:
        InputError: a value out of range, motion blur without exposures, or a folder with a set of other settings.
        OutputError: the folder cannot be written, or holds scenes or a preview without an index.
    """
    out = Path(out)
    check_set(count, seed)
    check_choice("kind", kind, get_args(Kind))
    if (config.shutter > 0) != (config.exposures > 1):
        raise InputError(
            f"shutter is {config.shutter} with {config.exposures} exposures; motion blur needs a shutter above 0 and "
            "at least 2 exposures, sharp images a shutter of 0 and 1"
        )
    textures = load_textures(split)
    config = dataclasses.replace(config, dynamic=float(kind == "dynamic"))
    index = _describe(config, kind, split, seed)
    stream = jax.random.fold_in(jax.random.key(seed), _STREAM)

    def draw(number: int) -> SceneFiles:
        return _files_of(jax.device_get(_draw(jax.random.fold_in(stream, number), textures, config)))

    return write_set(out, index, count, draw, f"{kind} scenes, seed {seed}, {split} textures", progress)


def write_set(
    out: Path,
    index: dict[str, Any],
    count: int,
    draw: Callable[[int], SceneFiles],
    title: str,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the scenes that `draw` gives by number, with an index and a preview; existing scenes are kept.

    Raises InputError and OutputError as `write_scenes` does.
    """
    _check_folder(out, index)
    folders = [out / f"scene_{number:04d}" for number in range(count)]
    _write_index(out, index)  # first, so that no scene is ever without an index
    missing = [number for number in range(count) if not folders[number].is_dir()]
    for done, number in enumerate(missing, start=count - len(missing)):
        (progress or no_progress)(done, count)
        with staging(out) as staged:
            scene = staged / "scene"
            scene.mkdir()
            _write_scene(scene, draw(number))
            scene.rename(folders[number])
        _write_index(out, index)
    with writing(out / PREVIEW) as path:
        draw_sheet(folders, title).save(path)
    (progress or no_progress)(count, count)
    return folders


def read_index(out: str | Path) -> dict[str, Any]:
    """Return the content of a set's index.json. Raises InputError unless it is an index of this format."""
    path = Path(out) / INDEX
    index = read_json(path, dict[str, Any], "index of scenes", most_bytes=_INDEX_BYTES)
    if index.get("format") != "vggtjax scenes":
        raise InputError(f"{path} is not the index of a set of scenes; choose another folder")
    if index.get("version") != _FORMAT_VERSION:
        raise InputError(f"{path} has version {one_line(repr(index.get('version')), 60)}; expected {_FORMAT_VERSION}")
    return index


def check_set(count: int, seed: int) -> None:
    """Raise InputError for a number of scenes or a seed out of range."""
    if type(count) is not int or not 1 <= count <= _MOST_SCENES:
        raise InputError(f"count is {count!r}; expected a whole number from 1 to {_MOST_SCENES}")
    if type(seed) is not int or not 0 <= seed < 2**31:
        raise InputError(f"seed is {seed!r}; expected a whole number in [0, 2**31)")


def _check_folder(out: Path, index: dict[str, Any]) -> None:
    """Raise unless `out` holds no scenes, or scenes of the same settings."""
    if not os.path.lexists(out / INDEX):
        leftovers = [*out.glob(PREVIEW), *out.glob("scene_*")]
        if leftovers:
            raise OutputError(f"{leftovers[0]} exists without {INDEX} beside it; choose another folder or move it away")
        return
    existing = read_index(out)
    # Sets of worlds have other fields.
    if isinstance(existing.get("config"), dict) and _LATER.keys() <= index["config"].keys():
        existing["config"] = _LATER | existing["config"]
    other = [name for name in ("kind", "split", "seed", "config") if existing.get(name) != index[name]]
    if other:
        values = ", ".join(_difference(name, existing.get(name), index[name]) for name in other)
        raise InputError(f"{out} holds scenes with {values}; choose another folder, or the same settings to resume")


def _difference(name: str, there: Any, wanted: Any) -> str:
    """Say how two values differ; of two dictionaries, in which of their values."""
    if not (isinstance(there, dict) and isinstance(wanted, dict)):
        return f"{name} {there!r} instead of {wanted!r}"
    keys = [key for key in sorted({*there, *wanted}) if there.get(key) != wanted.get(key)]
    return ", ".join(_difference(f"{key} of {name}", there.get(key), wanted.get(key)) for key in keys)


def _describe(config: SceneConfig, kind: str, split: str, seed: int) -> dict[str, Any]:
    """Return the index of a set without its scenes."""
    return {
        **MARKS,
        "about": "Generated rooms in which things stand or move, seen by a hand-held camera, with exact truth.",
        "conventions": CONVENTIONS,
        "files": FILES,
        "kind": kind,
        "split": split,
        "seed": seed,
        "key": f"scene n is generate(fold_in(fold_in(key({seed}), {_STREAM}), n), textures of the split, config)",
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "objects": [0, *(1 + number for number in config.objects)],
        "about_objects": "thing that each part belongs to, by number of the part; 0 is the room, 1 the figure",
    }


def _write_index(out: Path, index: dict[str, Any]) -> None:
    scenes = sorted(path.name for path in out.glob("scene_[0-9][0-9][0-9][0-9]") if path.is_dir())
    index = index | {"config": without_defaults(index["config"], _LATER), "scenes": scenes}
    with writing(out / INDEX) as path:
        path.write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")


def _files_of(clip: SyntheticClip) -> SceneFiles:
    pictures = in_bytes(np.asarray(clip.images))
    parts, cameras = np.asarray(clip.part_ids, np.uint8), (clip.camera_from_world, clip.intrinsics)
    return SceneFiles(pictures, clip.depth, clip.dynamic_mask, parts, clip.scene_flow, *cameras, clip.world_from_part)  # pyright: ignore


def _write_scene(folder: Path, clip: SceneFiles) -> None:
    """Write a scene into the empty `folder`."""
    S, H, W = clip.depth.shape
    poses = world_from_camera(np.asarray(clip.camera_from_world))
    write_trajectory(folder / "trajectory.txt", poses, np.arange(S, dtype=np.float64))
    write_intrinsics(folder / "intrinsics.txt", list(np.asarray(clip.intrinsics)), [(H, W)] * S)
    if clip.world_from_part is not None:
        np.save(folder / "part_poses.npy", np.asarray(clip.world_from_part, np.float32), allow_pickle=False)
    for name in ("images", "depth", "mask", "parts", "flow"):
        (folder / name).mkdir()
    with ThreadPoolExecutor(min(_WORKERS, os.cpu_count() or 1)) as pool:
        list(pool.map(partial(_write_frame, folder, clip), range(S)))


def _write_frame(folder: Path, clip: SceneFiles, frame: int) -> None:
    depth = np.asarray(clip.depth[frame])
    pictures = {
        "images": clip.images[frame],
        "depth": encode_depth(depth, (depth > 0) & (depth < _MOST_DEPTH), _MILLIMETRES),
        "mask": np.uint8(255) * clip.dynamic_mask[frame],
        "parts": clip.parts[frame],
    }
    for name, pixels in pictures.items():
        Image.fromarray(pixels).save(folder / name / f"{frame:05d}.png", compress_level=_PNG_LEVEL)
    for name, values in (("depth", depth), ("flow", clip.scene_flow[frame])):
        np.save(folder / name / f"{frame:05d}.npy", np.asarray(values, np.float32), allow_pickle=False)
