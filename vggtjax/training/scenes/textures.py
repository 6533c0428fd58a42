"""Textures of the generated scenes: photographs and materials from scikit-image, and procedural textures."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8
from PIL import Image

from vggtjax.clips.media.arrays import in_bytes
from vggtjax.errors import check_choice
from vggtjax.training.scenes.config import Split
from vggtjax.training.scenes.pyramid import texels

SIDES = (256, 128, 64, 32, 16)  # pyramid of a tile, finest first
PHOTOGRAPHS = (
    "astronaut.png", "brick.png", "camera.png", "cell.png", "chelsea.png", "coffee.png", "coins.png", "grass.png",
    "gravel.png", "hubble_deep_field.jpg", "ihc.png", "moon.png", "motorcycle_left.png", "page.png", "retina.jpg",
    "rocket.jpg", "text.png",
)  # fmt: skip
SHARES = {"training": (0.0, 0.62), "test": (0.66, 1.0)}  # of a photograph's width: the crops are disjoint
CROPS = {"training": 3, "test": 2}  # per photograph
PROCEDURAL = 16  # tiles per split
SEEDS = {"training": 0, "test": 1}


class Textures(NamedTuple):
    """Square RGB tiles with their pyramids, in one row of texels: level by level, in each level tile by tile."""

    texels: UInt8[Array, "N 3"]

    @property
    def tiles(self) -> int:
        """Number of tiles, from the shape."""
        return self.texels.shape[0] // sum(side * side for side in SIDES)


def load_textures(split: Split = "training") -> Textures:
    """Return the tiles of a split. Crops of photographs and seeds of procedural tiles are disjoint between splits."""
    check_choice("texture split", split, get_args(Split))
    generator = np.random.default_rng(SEEDS[split])
    tiles = [tile for name in PHOTOGRAPHS for tile in _crops(name, split, generator)]
    tiles += [_procedural(generator, kind) for kind in range(PROCEDURAL)]
    return Textures(jnp.asarray(texels(tiles, SIDES)))


def sample(
    textures: Textures, tile: Int[Array, " P"], uv: Float[Array, "2 P"], footprint: Float[Array, " P"]
) -> Float[Array, "3 P"]:
    """Return bilinear samples, RGB in [0, 1], of every pixel's tile.

    The position `uv` is in units of a tile's side; outside [0, 1] the tile repeats, mirrored. The pixel's footprint on
    the tile, in the same units, decides the level of the pyramid.
    """
    level = jnp.log2(jnp.maximum(footprint * SIDES[0], 1e-6))
    level = jnp.clip(jnp.round(level), 0, len(SIDES) - 1).astype(jnp.int32)
    side = SIDES[0] >> level
    starts = np.concatenate([[0], np.cumsum([s * s for s in SIDES])[:-1]]) * textures.tiles
    start = jnp.asarray(starts, jnp.int32)[level] + tile * side * side
    folded = jnp.abs(jnp.mod(uv, 2.0) - 1)  # mirrored repetition
    position = jnp.clip(folded * side[None] - 0.5, 0, side[None] - 1)
    low = jnp.minimum(position.astype(jnp.int32), side[None] - 2)
    fx, fy = position - low
    corner = start + low[1] * side + low[0]

    def texel(offset: Int[Array, " P"]) -> Float[Array, "P 3"]:
        return textures.texels[corner + offset].astype(jnp.float32)

    top = texel(jnp.zeros_like(corner)) * (1 - fx)[:, None] + texel(jnp.ones_like(corner)) * fx[:, None]
    bottom = texel(side) * (1 - fx)[:, None] + texel(side + 1) * fx[:, None]
    return (top * (1 - fy)[:, None] + bottom * fy[:, None]).T / 255


def _crops(name: str, split: Split, generator: np.random.Generator) -> list[UInt8[np.ndarray, "256 256 3"]]:
    import skimage

    path = Path(skimage.__file__).parent / "data" / name
    with Image.open(path) as image:
        picture = image.convert("RGB")
    low, high = (round(share * picture.width) for share in SHARES[split])
    picture = picture.crop((low, 0, high, picture.height))
    tiles = []
    for _ in range(CROPS[split]):
        side = int(min(picture.size) * generator.uniform(0.5, 1.0))
        x, y = (int(generator.integers(0, length - side + 1)) for length in picture.size)
        tile = picture.crop((x, y, x + side, y + side)).resize((SIDES[0], SIDES[0]), Image.Resampling.BICUBIC)
        tiles.append(np.asarray(tile))
    return tiles


def _procedural(generator: np.random.Generator, kind: int) -> UInt8[np.ndarray, "256 256 3"]:
    """Return a tile of noise, squares, stripes or dots between two random colours."""
    side = SIDES[0]
    y, x = np.mgrid[0:side, 0:side] / side
    noise = np.zeros((side, side))
    for octave in range(2, 7):
        grid = generator.random((2**octave, 2**octave)).astype(np.float32)
        noise += np.asarray(Image.fromarray(grid).resize((side, side), Image.Resampling.BICUBIC)) / octave
    noise = (noise - noise.min()) / np.ptp(noise)
    count = int(generator.integers(3, 9))
    cells = (np.floor(x * count) * 7 + np.floor(y * count) * 13).astype(int)
    pattern = [
        noise,
        generator.random(256)[cells % 256],
        0.5 + 0.5 * np.sin(2 * np.pi * count * (x + 0.3 * noise)),
        np.hypot((x * count) % 1 - 0.5, (y * count) % 1 - 0.5) < 0.2 + 0.25 * generator.random(256)[cells % 256],
    ][kind % 4].astype(float)
    mix = np.clip(0.75 * pattern + 0.25 * noise, 0, 1)[..., None]
    first, second = generator.random((2, 3))
    colour = mix * first + (1 - mix) * second
    return in_bytes(np.clip(colour, 0, 1))
