"""The preview of a set of scenes: frames, and the truth of the middle frame. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from vggtjax.results.grid import Row, draw_grid, fitted
from vggtjax.results.previews import INSTANCE_COLORS, color_depth, inverse_depth_range, overlay

_MOST_ROWS = 8
_THUMBNAIL = (260, 200)  # widest and highest
_REST = np.array([48, 48, 54], np.uint8)
_COLUMNS = ("first", "middle", "last", "depth", "dynamic", "parts", "flow")


def draw_sheet(scenes: Sequence[Path], title: str) -> Image.Image:
    """Draw up to eight scenes, evenly spread, a row each: three frames, then depth, mask, parts and flow of the middle.

    `scenes` are folders that `write_scenes` wrote, of images of one size.
    """
    chosen = [scenes[i] for i in np.linspace(0, len(scenes) - 1, min(len(scenes), _MOST_ROWS)).round().astype(int)]
    pictures = [_row(scene) for scene in chosen]
    size = fitted(pictures[0][0].shape[:2], _THUMBNAIL)
    rows = []
    for scene, (*mixed, parts, flow) in zip(chosen, pictures, strict=True):
        unmixed = [Image.fromarray(picture).resize(size, Image.Resampling.NEAREST) for picture in (parts, flow)]
        rows.append(Row(scene.name, [*mixed, *map(np.asarray, unmixed)]))  # their mixed colours would have no meaning
    return Image.fromarray(draw_grid(title, _COLUMNS, rows, size))


def color_flow(flow: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colour flow along x, y, z as red, green, blue around mid grey; the fastest has full colour, rest is dark."""
    fastest = np.abs(flow).max()
    moving = np.linalg.norm(flow, axis=-1) > 1e-4
    colors = (255 * (0.5 + 0.5 * flow / max(float(fastest), 1e-4))).round().astype(np.uint8)
    return np.where(moving[..., None], colors, _REST)


def _row(scene: Path) -> list[np.ndarray]:
    names = sorted(path.stem for path in (scene / "images").glob("*.png"))
    middle = names[len(names) // 2]
    images = [_pixels(scene / f"images/{name}.png") for name in (names[0], middle, names[-1])]
    depth = np.load(scene / f"depth/{middle}.npy", allow_pickle=False)
    valid = depth > 0
    mask, parts = _pixels(scene / f"mask/{middle}.png") > 0, _pixels(scene / f"parts/{middle}.png")
    return [
        *images,
        color_depth(depth, valid, inverse_depth_range(depth[None], valid[None])),
        overlay(images[1], mask),
        np.where(parts[..., None] > 0, INSTANCE_COLORS[parts], _REST),  # alike in all pictures; the room is grey
        color_flow(np.load(scene / f"flow/{middle}.npy", allow_pickle=False)),
    ]


def _pixels(path: Path) -> np.ndarray:
    with Image.open(path, formats=("PNG",)) as image:
        return np.asarray(image)
