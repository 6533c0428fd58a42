"""Ways to enlarge depth to the source's size, compared: python -m benchmarks resolution."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from benchmarks.real_clips import read_picture
from vggtjax.errors import InputError
from vggtjax.results.frame import enlarged_depth

_OFF = 0.05  # relative error from which a pixel counts as misplaced
Axis = Float[np.ndarray, " n"]


def resolution(*, clips: Path, factors: tuple[float, ...] = (1.24, 1.65, 1.85, 3.7), every: int = 4) -> None:
    """Shrink measured depth to the pixels of a smaller picture, enlarge it again, and compare it with the original.

    Args:
        clips: folder of folders with depth/: pictures of one channel, in any unit, 0 where unknown.
        factors: by which the depth is shrunk, every small pixel taking the depth at its centre; by default what takes
            frames of 518 pixels to pictures of 640, 854, 960 and 1920.
        every: step between the frames used.
    """
    if min(*factors, every, 2) < 1 or not factors:
        raise InputError(f"factors are {factors} and every is {every}; expected whole numbers above 0")
    folders = sorted(folder.parent for folder in clips.rglob("depth") if any(folder.glob("*.png")))
    if not folders:
        raise InputError(f"{clips} has no clips; expected folders with pictures in depth/")
    console = Console()
    for factor in factors:
        table = Table(title=f"enlarged {factor:g} times", title_justify="left", box=None, pad_edge=False)
        for heading in ("clip", "way", "mean relative error", f"off by more than {_OFF:.0%}"):
            table.add_column(heading, justify="left" if heading in ("clip", "way") else "right")
        scores: dict[str, list[tuple[float, float]]] = {name: [] for name in WAYS}
        for folder in folders:
            for name, way in WAYS.items():
                errors = np.concatenate([_errors(path, way, factor) for path in _frames(folder)[::every]])
                error, off = errors.mean(), (errors > _OFF).mean()
                scores[name].append((error, off))
                table.add_row(folder.name, name, f"{error:.4f}", f"{off:.2%}")
        for name, values in scores.items():
            error, off = np.mean(values, axis=0)
            table.add_row("mean", name, f"{error:.4f}", f"{off:.2%}")
        console.print(table)


def _frames(folder: Path) -> list[Path]:
    return sorted((folder / "depth").glob("*.png"))


def _errors(path: Path, way: Callable[[np.ndarray, Axis, Axis], np.ndarray], factor: float) -> np.ndarray:
    true = read_picture(path).astype(np.float64)
    rows, columns = (np.floor((np.arange(int(side / factor)) + 0.5) * factor).astype(int) for side in true.shape)
    small = true[np.ix_(rows, columns)]
    height, width = (int(count * factor) for count in small.shape)
    true = true[:height, :width]
    x, y = ((np.arange(side) + 0.5) / factor for side in (width, height))
    known = (true > 0) & (_bilinear((small > 0).astype(np.float64), x, y) > 0.999)  # all four neighbours are known
    return np.abs(way(small, x, y)[known] - true[known]) / true[known]


def _nearest(depth: np.ndarray, x: Axis, y: Axis) -> np.ndarray:
    return depth[np.ix_(np.floor(y).astype(int), np.floor(x).astype(int))]


def _bilinear(depth: np.ndarray, x: Axis, y: Axis) -> np.ndarray:
    from scipy.ndimage import map_coordinates

    places = np.stack(np.meshgrid(y - 0.5, x - 0.5, indexing="ij"))
    return map_coordinates(depth, places, order=1, mode="nearest")


def _bilinear_inverse(depth: np.ndarray, x: Axis, y: Axis) -> np.ndarray:
    return 1 / _bilinear(1 / np.where(depth > 0, depth, 1), x, y)  # unknown pixels are not compared


WAYS = {
    "nearest": _nearest,
    "bilinear": _bilinear,
    "bilinear in the inverse": _bilinear_inverse,
    "edge-aware": enlarged_depth,
}
