"""Depth Anything 3 with seeded weights, and what its public code computed with them (tests/golden/da3).

python -m tests.shared.da3 OUT NAME writes a file as published: NAME is da3-small or da3-base.
"""

from __future__ import annotations

import functools
import json
import re
import sys
from typing import Any

import jax
import numpy as np
from safetensors.numpy import save_file

from converters import convert_state_dict
from tests.shared.golden import GOLDEN
from tests.shared.seeded import seeded_images, seeded_tensor
from vggtjax.config import DA3, FAMILIES, MotionConfig, VGGTConfig
from vggtjax.network.layers import Params

TINY = VGGTConfig(
    image_size=98,
    embed_dim=32,
    depth=4,
    num_heads=2,
    dino_depth=4,
    dino_num_heads=2,
    camera_depth=4,
    camera_num_heads=4,
    dpt_features=16,
    dpt_channels=(8, 16, 24, 32),
    taps=(0, 1, 2, 3),
    heads=FAMILIES["da3"].heads,
    motion=MotionConfig(mask_pairs=2),
    family="da3",
)
CONFIGS = {"tiny": TINY, "da3-small": DA3["da3-small"], "da3-base": DA3["da3-base"]}

_SHARED = re.compile(r"(\.output_conv2_aux\.)[123](\.2\.)")  # one norm, under four names
_DAMPED = ("fc_fov.0.weight", "scratch.output_conv2.2.weight")  # depth is an exponential; a field of view is cut at 0


def shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a model's state dict, by name."""
    values = json.loads((GOLDEN / f"da3/shapes_{name.removeprefix('da3-')}.json").read_text())
    return {key: tuple(shape) for key, shape in values.items()}


def seeded_weights(name: str, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a seeded state dict as it is in memory: with all four names of the shared norm."""
    weights = {}
    for key, shape in shapes(name).items():
        values = seeded_tensor(_SHARED.sub(r"\g<1>0\2", key), shape, seed)
        values = values * np.float32(0.25) if key.endswith(_DAMPED) else values
        weights[key] = values + np.float32(1) if key.endswith("fc_fov.0.bias") else values
    return weights


def published(weights: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return weights as published files name them: with a prefix, and the shared norm once."""
    return {f"model.{key}": value for key, value in weights.items() if not _SHARED.search(key)}


@functools.cache
def seeded_params(name: str, seed: int) -> Params:
    """Return the parameters of a seeded model."""
    return jax.device_put(convert_state_dict(published(seeded_weights(name, seed)), CONFIGS[name]))


class GoldenPass:
    """Inputs and outputs of passes.

    Attributes:
        arrays: what the public code computed, by name, such as "plain/depth" or "drop/pose_enc".
        config, params: the model.
        size: height and width in pixels.
        images: [B, S, H, W, 3] in [0, 1].
        tokens: the dynamic tokens of the masked passes, [B, S, h, w].
    """

    def __init__(self, name: str) -> None:
        self.arrays: Any = np.load(GOLDEN / f"da3/{name}.npz")
        meta = json.loads(str(self.arrays["meta"]))
        self.config, self.params = CONFIGS[meta["config"]], seeded_params(meta["config"], meta["seed"])
        self.size = (meta["height"], meta["width"])
        images = [seeded_images(meta["frames"], *self.size, meta["seed"] + b) for b in range(meta["batch"])]
        self.images = np.stack(images).transpose(0, 1, 3, 4, 2)
        self.tokens: Any = None
        if "patch_masks" in self.arrays:
            self.tokens = self.arrays["patch_masks"].astype(bool)


if __name__ == "__main__":
    save_file(published(seeded_weights(sys.argv[2])), sys.argv[1], {"format": "pt"})
