"""A small folder of assets that tests make: textures of every material, photographs, panoramas, and objects."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from vggtjax.training.world.assets import MATERIALS


def write_assets(folder: Path) -> Path:
    """Write a folder with five files of each kind, of which one is for test scenes."""
    generator = np.random.default_rng(0)
    for name in ("textures", "photos", "objects"):
        (folder / name).mkdir(parents=True)
    for word in sorted({words[0] for words in MATERIALS.values()}):
        for number in range(5):
            _picture(folder / f"textures/{word}_{number}.png", generator, (32, 32))
    for number in range(5):
        _picture(folder / f"photos/hdri_place{number}_000.png", generator, (24, 32))
        _picture(folder / f"photos/pano_place{number}.png", generator, (32, 64))
    for number in range(5):
        _object(folder / f"objects/box{number}.npz", generator, (0.6, 0.4, 0.3 + 0.1 * number))
        _object(folder / f"objects/car{number}.npz", generator, (1.8, 4.0, 1.5))
        _object(folder / f"objects/anim_figure{number}_walk.npz", generator, (0.5, 0.4, 1.7), poses=4)
    return folder


def _picture(path: Path, generator: np.random.Generator, size: tuple[int, int]) -> None:
    noise = generator.integers(0, 256, (*size, 3)).astype(np.uint8)
    Image.fromarray(noise).save(path)


def _object(path: Path, generator: np.random.Generator, size, poses: int = 0) -> None:
    mesh = trimesh.creation.box(extents=size)
    vertices = np.asarray(mesh.vertices, np.float32) + np.asarray([0, 0, size[2] / 2], np.float32)
    if poses:  # a figure that bends forth and back
        lean = 0.2 * np.sin(2 * np.pi * np.arange(poses) / poses)[:, None]
        vertices = np.repeat(vertices[None], poses, axis=0)
        vertices[..., 1] += lean * vertices[..., 2]
    uv = generator.random((len(mesh.vertices), 2)).astype(np.float32)
    texture = generator.integers(0, 256, (16, 16, 3)).astype(np.uint8)
    arrays = {"vertices": vertices, "faces": np.asarray(mesh.faces, np.int32), "uv": uv, "texture": texture}
    arrays |= {"fps": np.float32(8)} if poses else {}
    np.savez(path, allow_pickle=False, **arrays)
