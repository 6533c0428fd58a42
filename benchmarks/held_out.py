"""Held-out clips with exact truth: rooms, or worlds of the test split of a folder of assets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vggtjax.clips.truth import Truth, batched_truth
from vggtjax.training.scenes import SceneConfig, held_out_scenes
from vggtjax.training.scenes.held_out import Kind
from vggtjax.training.world.truth import worlds_with_truth


def held_out_truth(kind: Kind, count: int, config: SceneConfig, *, seed: int, assets: Path | None = None) -> Truth:
    """Return `count` clips of a seed, with a leading axis; of worlds only the size and the frames of `config` count."""
    if assets is None:
        return batched_truth(held_out_scenes(kind, count, config, seed=seed))
    shape = {"frames": config.frames, "height": config.height, "width": config.width}
    worlds = [*worlds_with_truth(assets, kind, count, split="test", seed=seed, **shape)]
    return Truth(*(np.stack(arrays) for arrays in zip(*worlds, strict=True)))
