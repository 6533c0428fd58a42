"""Numbers that the public PyTorch code computed for seeded weights, and how far ours may be from them.

They lie in tests/golden of the repository.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from converters import convert_state_dict
from tests.shared.seeded import seeded_images, seeded_state_dict
from vggtjax.config import VGGTConfig
from vggtjax.network.layers import Params
from vggtjax.research.parity.outputs import OUTPUTS as PUBLIC
from vggtjax.research.parity.outputs import TOLERANCE as TOLERANCE

GOLDEN = Path(__file__).parents[1] / "golden"
FORWARD = ("single", "frames4", "batch2")  # the cases of a pass
BFLOAT16 = {"pose_enc": 0.06, "depth": 0.25, "depth_conf": 0.15}  # likewise; measured: half of it

OUTPUTS = {name: output.public for name, output in PUBLIC.items() if output.most is None}  # field -> name in the files


def golden_config() -> VGGTConfig:
    """Return the tiny model: 24 pairs like VGGT-1B, so that every layer index is a real one."""
    return VGGTConfig(**json.loads((GOLDEN / "config.json").read_text()))


@functools.cache
def golden_params(seed: int) -> Params:
    """Return the tiny model's parameters for a seed."""
    shapes = json.loads((GOLDEN / "shapes.json").read_text())
    return jax.device_put(convert_state_dict(seeded_state_dict(shapes, seed), golden_config()))


class GoldenPass:
    """Inputs and outputs of the plain pass and of the masked ones.

    Attributes:
        arrays: what the public code computed, by name, such as "plain/depth" or "drop/pose_enc".
        config, params: the tiny model.
        size: height and width in pixels.
        images: [B, S, H, W, 3] in [0, 1].
        tokens: the dynamic tokens of the masked passes, [B, S, h, w].
    """

    def __init__(self, name: str) -> None:
        self.arrays: Any = np.load(GOLDEN / f"forward_{name}.npz")
        meta = json.loads(str(self.arrays["meta"]))
        self.config, self.params = golden_config(), golden_params(meta["seed"])
        self.size = (meta["height"], meta["width"])
        images = [seeded_images(meta["frames"], *self.size, meta["seed"] + b) for b in range(meta["batch"])]
        self.images = np.stack(images).transpose(0, 1, 3, 4, 2)
        p = self.config.patch_size
        h, w = self.size[0] // p, self.size[1] // p
        self.tokens = self.arrays["masks"].reshape(meta["batch"], meta["frames"], h, p, w, p).any(axis=(3, 5))


def spread_error(made: Any, golden: np.ndarray) -> float:
    """Return the largest difference in standard deviations of the golden array."""
    return float(np.abs(np.asarray(made).reshape(golden.shape) - golden).max() / golden.std())
