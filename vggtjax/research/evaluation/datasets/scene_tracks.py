"""Exact tracks of a generated scene, from its parts, their poses and depth. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.cameras import project, world_from_camera
from vggtjax.clips.captures.depth_files import read_npy
from vggtjax.clips.captures.files import files
from vggtjax.clips.captures.pictures import PNG, opening
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets.true_tracks import TrueTracks
from vggtjax.storage.arrays import read_array

_EVERY = 8  # pixels of the first frame between two tracks
_SAME = 0.02  # share of the depth by which a visible point may lie behind the surface of its pixel


def scene_tracks(
    folder: Path, names: Sequence[str], poses: Float64[np.ndarray, "S 4 4"], intrinsics: Float64[np.ndarray, "S 3 3"]
) -> TrueTracks | None:
    """Return tracks of the centres of every eighth pixel of the first frame of a scene of `vggtjax scenes`.

    A point moves with its part, and is visible where its pixel shows that part at its depth. None for other folders.

    Args:
        folder: of the scene, with parts/, part_poses.npy and depth/.
        names: of the frames.
        poses: of these frames, world from camera.
        intrinsics: of these frames, pixel edges at whole numbers.
    """
    parts, depths = files(folder / "parts", ".png"), files(folder / "depth", ".npy")
    if not (folder / "part_poses.npy").is_file() or not all(name in parts and name in depths for name in names):
        return None
    moved = read_array(folder / "part_poses.npy").astype(np.float64)
    numbers = {name: number for number, name in enumerate(parts)}
    if moved.ndim != 4 or moved.shape[2:] != (3, 4) or len(moved) != len(numbers):
        raise InputError(f"{folder / 'part_poses.npy'} has shape {moved.shape}; expected [{len(numbers)}, K, 3, 4]")
    rows = [numbers[name] for name in names]
    cameras = world_from_camera(poses[:, :3])[:, :3]
    first, depth = _labels(parts[names[0]]), read_npy(depths[names[0]])
    y, x = (
        values.ravel() for values in np.mgrid[_EVERY // 2 : len(depth) : _EVERY, _EVERY // 2 : depth.shape[1] : _EVERY]
    )
    rays = np.linalg.solve(intrinsics[0], np.stack([x + 0.5, y + 0.5, np.ones(len(x))]))
    seen = (poses[0, :3, :3] @ (rays * depth[y, x])).T + poses[0, :3, 3]
    own = first[y, x]
    if own.max() >= moved.shape[1]:
        raise InputError(
            f"{parts[names[0]]} shows part {own.max()}; expected less than {moved.shape[1]}, as part_poses.npy"
        )
    later = moved[rows][:, own]  # [S, N, 3, 4]
    start = later[0]
    within = np.einsum("nji,nj->ni", start[:, :, :3], seen - start[:, :, 3])  # in the part
    points = np.einsum("snij,nj->sni", later[..., :3], within) + later[..., 3]
    visible = np.zeros(points.shape[:2], bool)
    for frame, name in enumerate(names):
        labels, surface = _labels(parts[name]), read_npy(depths[name])
        u, v, away = project(points[frame], cameras[frame], intrinsics[frame])
        inside = (away > 0) & (u >= 0) & (v >= 0) & (u < labels.shape[1]) & (v < len(labels))
        column, row = u[inside].astype(int), v[inside].astype(int)
        near = np.abs(surface[row, column] - away[inside]) <= _SAME * away[inside]
        visible[frame, inside] = (labels[row, column] == own[inside]) & near
    return TrueTracks(points, visible)


def _labels(path: Path) -> np.ndarray:
    with opening(path, PNG) as image:
        return np.asarray(image)
