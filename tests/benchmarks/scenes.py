"""Stand-ins for what takes long: scenes that are drawn and not rendered, rows of the ladder, a tiny model in a file."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.shared.tiny import tiny_config
from vggtjax.network.checkpoint import save_model
from vggtjax.network.model import init_params
from vggtjax.research.evaluation.ladder import LadderRow
from vggtjax.training.scenes import SceneConfig, SyntheticClip

SIDE = 28


def tiny_file(folder: Path) -> Path:
    """Write a model for pictures of 28 x 28 pixels."""
    config = tiny_config(image_size=SIDE)

    def layer_scale(path, leaf):  # so large that attention shows
        return jnp.full_like(leaf, 0.5) if path[-1].key in ("scale1", "scale2") else leaf

    params = jax.tree_util.tree_map_with_path(layer_scale, init_params(0, config))
    return save_model(folder / "tiny.safetensors", params, config)


def drawn_scenes(kind: str, count: int, config: SceneConfig, *, seed: int = 0) -> SyntheticClip:
    """Return noise before a slanted wall, a box that moves if `kind` says so, and a camera on a bent path."""
    S, H, W = config.frames, config.height, config.width
    generator = np.random.default_rng([seed, count, kind == "dynamic"])
    depth = np.broadcast_to(2 + np.arange(W) / W, (count, S, H, W)).astype(np.float32)
    moving = np.zeros((count, S, H, W), bool)
    if kind == "dynamic":
        moving[:, :, H // 4 : H // 2, W // 4 : W // 2] = True
    poses = np.tile(np.eye(3, 4), (count, S, 1, 1))
    poses[..., 3] = 0.1 * np.arange(S)[:, None] + 0.03 * generator.normal(size=(count, S, 3))
    intrinsics = np.array([[W, 0, W / 2], [0, W, H / 2], [0, 0, 1.0]])
    images = generator.random((count, S, H, W, 3), np.float32)
    arrays: Any = (images, depth, None, None, moving, None, poses, np.tile(intrinsics, (count, S, 1, 1)), None)
    return SyntheticClip(*arrays)  # what is None no benchmark reads


def row(**fields) -> LadderRow:
    """Return a row of the ladder with a few fields."""
    values: dict[str, Any] = dict.fromkeys(LadderRow.__dataclass_fields__)
    return LadderRow(**(values | {"clip": 0, "method": "vggt", "failure": ""} | fields))
