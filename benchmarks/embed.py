"""Put a trained model and a held-out clip into the package, for `vggtjax demo`."""

from __future__ import annotations

import dataclasses
import hashlib

import jax
import numpy as np
from rich.console import Console
from scipy.stats import rankdata

from vggtjax.checkpoint import Model, numpy_dtype, save_model
from vggtjax.clips.truth import Truth
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.evaluation.ladder import ladder
from vggtjax.network.backbone import patch_positions
from vggtjax.network.layers import Params
from vggtjax.pretrained.embedded import CLIP, MODEL, NOTE, SCENE_SEED, UNTRAINED_HEADS, demo_model, write_demo_clip
from vggtjax.pretrained.load import load_model
from vggtjax.scenes import SceneConfig, held_out_scenes

MOST_MODEL_BYTES = 24 << 20
MOST_CLIP_BYTES = 1 << 20


def embed(model: str, /, *, frames: int = 16, scenes: int = 15, image_size: int | None = None) -> None:
    """Write the model, in bfloat16, and a held-out dynamic clip into the package.

    The clip is the median one of `scenes` by how the second pass, with mined masks, changes the errors of the cameras:
    scenes are ranked by the change of the rotation error and by that of the centres' error, and the scene with the
    median sum of ranks is taken. So the demo shows neither the best nor the worst of the method.

    Args:
        model: a .safetensors written by `vggtjax train` or `vggtjax calibrate-cues`.
        frames: of the clip.
        scenes: odd number of held-out scenes that the clip is chosen from.
        image_size: side in pixels that the model was last trained at, which becomes its own and the clip's; the
            model's own by default.
    """
    loaded = load_model(model)
    side = image_size or loaded.config.image_size
    network = dataclasses.replace(loaded.config, image_size=side)
    params = {**loaded.params, "backbone": _at_size(loaded.params["backbone"], loaded.config, network)}
    params = jax.tree.map(lambda leaf: np.asarray(leaf).astype(numpy_dtype("bfloat16")), params)
    save_model(MODEL, params, network, name="demo", note=NOTE, untrained_heads=UNTRAINED_HEADS)
    config = SceneConfig(height=side, width=side, frames=frames, samples=3)
    clips = held_out_scenes("dynamic", scenes, config, seed=SCENE_SEED)
    truth = Truth(*(getattr(clips, name) for name in Truth._fields))
    scene = _median_scene(demo_model(), truth)
    write_demo_clip(CLIP, Truth(*(array[scene] for array in truth)))
    console = Console()
    console.print(f"scene {scene} of {scenes} has the median change of the cameras' errors")
    for path, most in ((MODEL, MOST_MODEL_BYTES), (CLIP, MOST_CLIP_BYTES)):
        size = path.stat().st_size
        if size > most:
            raise InputError(f"{path} has {size} bytes; at most {most} go into the package")
        console.print(f"{path}  {size} bytes  sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}", soft_wrap=True)


def _median_scene(model: Model, truth: Truth) -> int:
    """Return the index of the scene whose cameras' errors the second pass changes by the median of all scenes."""
    rows = ladder(model, truth, methods=("vggt", "4dvggt-d"), masks=("mined",))
    first, second = (
        np.array([[row.rotation_error, row.centre_error_ratio] for row in rows if row.method == name], np.float64)
        for name in ("vggt", "4dvggt-d")
    )
    ranks = rankdata(second - first, axis=0).sum(axis=1)
    return int(np.argsort(ranks, kind="stable")[len(ranks) // 2])


def _at_size(backbone: Params, config: VGGTConfig, network: VGGTConfig) -> Params:
    """Return the backbone with its positions resized, as `encode` resizes them for images of that size."""
    positions = jax.numpy.asarray(backbone["position_embedding"], jax.numpy.float32)
    grid = (network.grid_size, network.grid_size)
    patches = patch_positions(positions[1:], config.grid_size, grid)
    return {**backbone, "position_embedding": jax.numpy.concatenate([positions[:1], patches])}
