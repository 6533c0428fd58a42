"""Clips of worlds with their truth, one at a time, to calibrate and to measure with."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vggtjax.clips.truth import Truth
from vggtjax.training.scenes.config import Split
from vggtjax.training.scenes.held_out import Kind
from vggtjax.training.world.assets import read_assets
from vggtjax.training.world.casting import check_embree
from vggtjax.training.world.clip import world_clip
from vggtjax.training.world.config import WorldConfig

_STREAMS = {"static": 0x7374696C, "dynamic": 0x6D6F7665}  # beside a seed, so that no other use of it draws these clips


def worlds_with_truth(
    assets: str | Path, kind: Kind, count: int, *, split: Split, seed: int, frames: int, height: int, width: int
) -> Iterator[Truth]:
    """Yield clips [S, ...] of the worlds of a folder of assets; a larger count begins with those of a smaller one.

    Raises InputError where the folder is not one of assets, and MissingExtraError without Embree.
    """
    check_embree()
    found, config = read_assets(assets, split), WorldConfig(dynamic=float(kind == "dynamic"))
    for number in range(count):
        clip = world_clip(found, config, (seed, _STREAMS[kind], number), frames=frames, height=height, width=width)
        intrinsics = np.broadcast_to(clip.intrinsics, (frames, 3, 3))
        images = (clip.images / 255).astype(np.float32)
        yield Truth(images, clip.depth, clip.dynamic_mask, clip.camera_from_world, intrinsics)
