"""The picture of a result that grows: half of a generated walk, and the other half added to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vggtjax import Reconstruction
    from vggtjax.network.checkpoint import Model

_OLD, _NEW, _TRUE = "#6db7ff", "#ff9a4a", "#f5f5f5"
_POINTS = 30_000


def grown(model: Model, scene: int, seed: int, frames: int, side: int) -> Figure:
    """The joined result from above, with the cameras of each half and the true ones; below, frames of both halves."""
    from matplotlib import pyplot

    import vggtjax
    from vggtjax.cameras import checked_centres, umeyama_sim3
    from vggtjax.pipeline.windows.plan import Extending
    from vggtjax.training.scenes.config import SceneConfig
    from vggtjax.training.scenes.held_out import held_out_scenes

    half = frames // 2
    drawn = held_out_scenes("dynamic", scene + 1, SceneConfig(height=side, width=side, frames=frames), seed=seed)
    images = np.rint(255 * drawn.images[scene]).astype(np.uint8)
    old = vggtjax.reconstruct(model, images[:half])
    both = vggtjax.extend(model, old, images[half:], extending=Extending(prefix="new_"))
    true = checked_centres(np.asarray(drawn.camera_from_world[scene]))
    world = umeyama_sim3(checked_centres(old.camera_from_world), true[:half])
    figure = pyplot.figure(figsize=(9.2, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, 8, height_ratios=(4, 1))
    centres = world.apply(checked_centres(both.camera_from_world))
    paths = {
        "true": (true, _TRUE),
        "of the result": (centres[:half], _OLD),
        "of the new frames": (centres[half:], _NEW),
    }
    above, enlarged = (figure.add_subplot(grid[0, 4 * column : 4 * column + 4]) for column in range(2))
    _points(above, both, world)
    for axes, title, size in ((above, "the joined result from above", 3), (enlarged, "its cameras, enlarged", 5)):
        for name, (path, colour) in paths.items():
            axes.plot(path[:, 0], path[:, 2], "o-", color=colour, label=name, markersize=size, linewidth=1)
        axes.set(title=title, xlabel="x, metres", ylabel="z, metres")
        axes.set_aspect("equal", "datalim")
    enlarged.legend()
    for place, frame in enumerate(np.linspace(0, frames - 1, 8).round().astype(int)):
        axes = figure.add_subplot(grid[1, place])
        axes.set(xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set(visible=True, color=_OLD if frame < half else _NEW, linewidth=2)
        axes.imshow(images[frame])
    return figure


def _points(axes: Any, result: Reconstruction, world: Any) -> None:
    """Plot static points from above, without the ceiling and the least confident ones."""
    confident = result.depth_confidence > np.quantile(result.depth_confidence, 0.3)
    shown = result.valid_pixels & ~result.dynamic_mask & confident
    points, colours = world.apply(result.world_points()[shown]), result.images[shown] / 255
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(inside))[:_POINTS]
    axes.scatter(points[chosen, 0], points[chosen, 2], c=colours[chosen], s=0.5, linewidths=0)
