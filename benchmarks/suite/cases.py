"""The measured models and their inputs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.suite.work import Grid
from tests.shared.seeded import seeded_images
from vggtjax.config import DA3, VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.layers import Params
from vggtjax.network.model import init_params
from vggtjax.pipeline.pretrained.embedded import demo_model

Size = Literal["tiny", "demo", "full", "da3-small", "da3-base"]
DType = Literal["float32", "bfloat16"]

TINY = VGGTConfig(
    image_size=56, embed_dim=16, depth=4, num_heads=2, dino_depth=1, dino_num_heads=2, camera_depth=1,
    camera_num_heads=2, dpt_features=8, dpt_channels=(8, 8, 8, 8), taps=(0, 1, 2, 3), heads=("camera", "depth"),
)  # fmt: skip
_FRAMES = {"full": (294, 518), "da3-small": (280, 504), "da3-base": (280, 504)}  # 16 : 9; others have square ones
_PAGE = 4096


@dataclass(frozen=True, eq=False)
class Case:
    """A model and the shape of a clip."""

    size: Size
    config: VGGTConfig
    params: Params = field(repr=False)
    frames: int
    height: int
    width: int
    dtype: DType

    @property
    def grid(self) -> Grid:
        """Rows and columns of patches."""
        return self.height // self.config.patch_size, self.width // self.config.patch_size

    def images(self) -> Float[Array, "1 S H W 3"]:
        """Draw a clip."""
        return jnp.asarray(seeded_images(self.frames, self.height, self.width).transpose(0, 2, 3, 1)[None])

    def drawn(self, *shape: int) -> Array:
        """Draw numbers on the device."""
        return jax.random.normal(jax.random.key(0), shape)


def config_of(size: Size) -> VGGTConfig:
    """Return the configuration of a size, without weights."""
    if size in DA3:
        return DA3[size]
    return {"tiny": lambda: TINY, "demo": lambda: demo_model().config, "full": VGGTConfig}[size]()


def load(size: Size) -> tuple[VGGTConfig, Params]:
    """Return the embedded model with all its pages in memory, or a random one."""
    if size != "demo":
        return config_of(size), init_params(0, config_of(size))
    model = demo_model()
    if jax.default_backend() == "cpu":
        for leaf in jax.tree.leaves(model.params):  # mapped files are read at the first access
            np.asarray(leaf).reshape(-1).view(np.uint8)[::_PAGE].sum()
    return model.config, model.params


def frame_size(size: Size, config: VGGTConfig, height: int | None, width: int | None) -> tuple[int, int]:
    """Return height and width in pixels; the defaults of `size` where None."""
    own = _FRAMES.get(size, (config.image_size, config.image_size))
    sides = (own[0] if height is None else height, own[1] if width is None else width)
    for name, side in zip(("height", "width"), sides, strict=True):
        if side < config.patch_size or side % config.patch_size:
            raise InputError(f"{name} is {side}; expected a multiple of {config.patch_size}, the patch of {size}")
    return sides


def check_counts(frames: tuple[int, ...], repeats: int = 1) -> None:
    """Raise InputError for invalid numbers of frames or of runs."""
    if not frames or min(frames) < 1:
        raise InputError(f"frames is {list(frames)}; expected numbers of at least 1")
    if repeats < 1:
        raise InputError(f"repeats is {repeats}; expected at least 1")
