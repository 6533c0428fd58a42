"""Generated clips with their truth, and what a model predicts of them: kept in a folder, so that a run resumes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from vggtjax.clips.clip import load_clip
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.run import reconstruct
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import FieldOfViewWarning
from vggtjax.storage.writing import writing
from vggtjax.training.scenes import SceneConfig, held_out_scenes
from vggtjax.training.scenes.held_out import Kind

FRAMES = 12


class KnownClip(NamedTuple):
    """A prediction, and the truth of its clip."""

    kind: Kind
    seed: int
    result: Reconstruction
    depth: np.ndarray  # [S, H, W] in metres
    camera_from_world: np.ndarray  # [S, 3, 4] in metres
    intrinsics: np.ndarray  # [S, 3, 3] in pixels


def clips_of_seed(model: Model, seed: int, clips: int, folder: Path) -> Iterator[KnownClip]:
    """Yield `clips` held-out clips of a seed, the first half static, then as many with moving objects."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, count in zip(get_args(Kind), (clips // 2, clips - clips // 2), strict=True):
        yield from _of_kind(model, kind, seed, count, folder)


def _of_kind(model: Model, kind: Kind, seed: int, count: int, folder: Path) -> Iterator[KnownClip]:
    side, patch = model.config.image_size, model.config.patch_size
    path = folder / f"{kind}-{seed}-{count}.npz"
    if not path.is_file():
        scenes = held_out_scenes(kind, count, SceneConfig(height=side, width=side, frames=FRAMES), seed=seed)
        with writing(path) as temporary, temporary.open("wb") as file:
            np.savez(
                file,
                images=scenes.images,
                depth=scenes.depth,
                camera_from_world=scenes.camera_from_world,
                intrinsics=scenes.intrinsics,
            )
    with np.load(path, allow_pickle=False) as truth:
        arrays = dict(truth)
    for number in range(count):
        archive = folder / f"{kind}-{seed}-{number}-result.npz"
        if not archive.is_file():
            clip = load_clip(arrays["images"][number], size=side, patch=patch)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FieldOfViewWarning)
                made = reconstruct(model, clip)
            with writing(archive) as temporary:
                made.save_archive(temporary)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FieldOfViewWarning)
            result = Reconstruction.load(archive)
        names = ("depth", "camera_from_world", "intrinsics")
        yield KnownClip(kind, seed, result, *(arrays[name][number] for name in names))
