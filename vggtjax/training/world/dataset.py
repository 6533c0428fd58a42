"""Write clips of worlds as a data set, in the layout of `vggtjax.training.scenes.dataset`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import get_args

import numpy as np

from vggtjax.errors import check_choice
from vggtjax.progress import Progress
from vggtjax.training.scenes.config import SceneConfig, Split
from vggtjax.training.scenes.dataset import CONVENTIONS, FILES, MARKS, SceneFiles, check_set, write_set
from vggtjax.training.scenes.held_out import Kind
from vggtjax.training.world.assets import fingerprint, read_assets
from vggtjax.training.world.casting import check_embree
from vggtjax.training.world.clip import GENERATOR, world_clip
from vggtjax.training.world.config import WorldConfig

_STREAM = 0x776F7264  # beside a seed, so that no clip of a training run is drawn
_PARTS = "0 stands still, 255 is sky, where depth is 0; what moves has its number from 1"


def write_worlds(
    out: str | Path,
    assets: str | Path,
    size: SceneConfig,
    config: WorldConfig | None = None,
    *,
    count: int,
    kind: Kind = "dynamic",
    split: Split = "training",
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """Generate clips of worlds into a folder; existing ones are kept, so the same call resumes an interrupted set.

    Args:
        out: folder of the set, made if missing.
        assets: folder of textures, photographs and objects; see `vggtjax.training.world.assets`.
        size: height, width and frames of the clips; its other fields are not read.
        config: what is drawn; `kind` replaces its `dynamic`.
        count: number of clips, at most 10 000.
        kind: "static", or "dynamic" where one to four things move.
        split: of the assets.
        seed: different seeds share no clip.
        progress: called with the number of complete clips and `count`.

    Returns:
        The folders of the clips.

    Raises:
        InputError: a value out of range, no folder of assets, or a folder with a set of other settings.
        OutputError: the folder cannot be written, or holds scenes or a preview without an index.
    """
    check_embree()
    check_set(count, seed)
    check_choice("kind", kind, get_args(Kind))
    check_choice("split", split, get_args(Split))
    out, found = Path(out), read_assets(assets, split)
    config = dataclasses.replace(config or WorldConfig(), dynamic=float(kind == "dynamic"))
    shape = {"frames": size.frames, "height": size.height, "width": size.width}
    drawn = {"generator": GENERATOR, "assets": fingerprint(assets), **shape, "world": dataclasses.asdict(config)}
    index = {
        **MARKS,
        "about": "Generated rooms, streets and landscapes in which things stand or move, with exact truth.",
        "conventions": {**CONVENTIONS, "world": "axes of the scene, z up", "parts": _PARTS},
        "files": {name: about for name, about in FILES.items() if name != "part_poses.npy"},
        "kind": kind,
        "split": split,
        "seed": seed,
        "config": json.loads(json.dumps(drawn)),
    }

    def draw(number: int) -> SceneFiles:
        clip = world_clip(found, config, (seed, _STREAM, number), **shape)
        intrinsics = np.broadcast_to(clip.intrinsics, (size.frames, 3, 3))
        truth = clip.dynamic_mask, clip.object_ids, clip.scene_flow, clip.camera_from_world, intrinsics
        return SceneFiles(clip.images, clip.depth, *truth, None)

    return write_set(out, index, count, draw, f"{kind} worlds, seed {seed}, {split} assets", progress)
