"""Time and memory of comparing two large point clouds: python -m benchmarks point-clouds."""

from __future__ import annotations

import resource
import sys
import time

import numpy as np
from jaxtyping import Float32
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.point_clouds import point_cloud_errors

ROOM = np.array([5.0, 2.6, 7.0])  # metres: width, height, length
PIXELS = (294, 518)  # of a frame: points are in the order of its rows, as in a clip
RELIEF = 0.03  # metres; furniture and folds


def point_clouds(*, points: int = 40_000_000, noise: float = 0.01, repeats: int = 1, seed: int = 0) -> None:
    """Time `point_cloud_errors` on the surfaces of a synthetic room, sampled twice by a walking camera.

    Args:
        points: points of each cloud.
        noise: standard deviation of the predicted points in each direction, in metres.
        repeats: runs.
        seed: another seed draws another relief, walk and noise.
    """
    for name, value in (("points", points), ("repeats", repeats)):
        if value < 1:
            raise InputError(f"{name} is {value}; expected at least 1")
    if noise < 0:
        raise InputError(f"noise is {noise}; expected at least 0")
    console = Console()
    with console.status("room"):
        truth = room(points, seed=seed)
        predicted = room(points, seed=seed, shift=0.37)
        predicted += noise * np.random.default_rng(seed).standard_normal(predicted.shape, dtype=np.float32)
    before = peak_memory()
    table = Table(title=f"{points:,} points against {points:,}, float32", box=None)
    for heading in ("", "seconds", "accuracy", "completeness"):
        table.add_column(heading, justify="right" if heading else "left")
    for repeat in range(repeats):
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(f"run {repeat + 1}", total=2 * points)
            began = time.perf_counter()
            errors = point_cloud_errors(
                predicted, truth, progress=lambda done, total, task=task: progress.update(task, completed=done)
            )
            seconds = time.perf_counter() - began
        means = (f"{statistics.mean:.5f}" for statistics in (errors.accuracy, errors.completeness))
        table.add_row(f"run {repeat + 1}", f"{seconds:.1f}", *means)
    console.print(table)
    console.print(
        f"peak memory {peak_memory():.2f} GB, of which {before:.2f} GB before the first run (the clouds among them)",
        highlight=False,
    )


def room(points: int, *, seed: int, shift: float = 0.0) -> Float32[np.ndarray, "N 3"]:
    """Return points on the walls of a room with some relief, frame by frame in the order of pixels.

    Args:
        points: number of points.
        seed: of the relief and the walk.
        shift: shift of the rays in pixels; another shift samples other points of the same surfaces.
    """
    generator = np.random.default_rng(seed)
    phases = generator.uniform(0, 2 * np.pi, 3)
    H, W = PIXELS
    frames = -(-points // (H * W))
    bends = generator.normal(size=(2, 4))
    cloud = np.empty((points, 3), np.float32)
    rows, columns = np.meshgrid(np.arange(H) + shift, np.arange(W) + shift, indexing="ij")
    rays = np.stack([(columns - W / 2) / (0.8 * W), (rows - H / 2) / (0.8 * W), np.ones((H, W))], axis=-1)
    for frame in range(frames):
        time_ = frame / max(frames - 1, 1)
        yaw = 2 * np.pi * time_ + 0.3 * np.sin(bends[0] @ (time_ ** np.arange(4)))
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turned = rays @ np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]).T
        walk = np.array([np.sin(2 * np.pi * time_), 0.3 * np.sin(bends[1] @ time_ ** np.arange(4)), np.cos(5 * time_)])
        start = 0.25 * ROOM * walk
        # The nearest wall along each ray, from inside the box.
        with np.errstate(divide="ignore"):
            depth = ((np.copysign(ROOM / 2, turned) - start) / turned).min(axis=-1, keepdims=True)
        hit = start + depth * turned
        waves = np.sin(7 * hit[..., [1, 2, 0]] + phases).prod(axis=-1, keepdims=True)
        surface = (hit + RELIEF * waves * np.sign(turned)).reshape(-1, 3)
        part = slice(frame * H * W, min((frame + 1) * H * W, points))
        cloud[part] = surface[: part.stop - part.start]
    return cloud


def peak_memory() -> float:
    """Return the peak memory of this process, in GB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e9 if sys.platform == "darwin" else peak * 1024 / 1e9  # macOS counts bytes, Linux KiB
