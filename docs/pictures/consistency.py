"""The pictures of consistent depth: its steps on a generated scene, and a wall from above before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vggtjax import Reconstruction
    from vggtjax.clips.truth import Truth
    from vggtjax.network.checkpoint import Model
    from vggtjax.pipeline.refinement.cells import Cells

SIDE = 288  # pixels of the source; the network sees fewer
_SURE = 25.0  # inverse variance of a log depth that is drawn
_CHANGE: dict[str, Any] = {"cmap": "RdBu", "vmin": -0.3, "vmax": 0.3}
_STRONGER = 10  # colours of what joining adds
_MARGIN = 0.8  # metres around the walls
_HEIGHTS = (0.1, 0.4)  # rows of pixels, as shares of the height, that are drawn from above: hardly any floor


class Fitted(NamedTuple):
    """A scene as it was predicted, with fields alone, and joined."""

    truth: Truth  # at the result's pixels
    pictures: np.ndarray
    predicted: Reconstruction
    fields: Reconstruction
    joined: Reconstruction


def fitted(model: Model, scene: int, seed: int, frames: int) -> Fitted:
    """Return a held-out scene whose source has more pixels than the network sees, reconstructed by `4dvggt-m`."""
    import vggtjax
    from vggtjax.clips.truth import Truth, at_clip_pixels, intrinsics_at_clip_pixels
    from vggtjax.pipeline.refinement.consistent import consistent_depth
    from vggtjax.pipeline.refinement.pixel_mask import mask_by_pixels
    from vggtjax.training.scenes.config import SceneConfig
    from vggtjax.training.scenes.held_out import held_out_scenes

    scenes = held_out_scenes("dynamic", scene + 1, SceneConfig(height=SIDE, width=SIDE, frames=frames), seed=seed)
    source = Truth(*(np.asarray(getattr(scenes, name)[scene]) for name in Truth._fields))
    pictures = np.rint(255 * source.images).astype(np.uint8)
    clip = vggtjax.load_clip(pictures, size=model.config.image_size, patch=model.config.patch_size)
    depth, moving = (at_clip_pixels(clip, values) for values in (source.depth, source.dynamic_mask))
    intrinsics = intrinsics_at_clip_pixels(clip, source.intrinsics)
    truth = Truth(clip.images, depth, moving, source.camera_from_world, intrinsics)
    predicted = vggtjax.reconstruct(model, clip, method="4dvggt-m")
    fields, joined = (consistent_depth(predicted, iter(pictures), join=join)[0] for join in (False, True))
    return Fitted(truth, pictures, predicted, fields, mask_by_pixels(joined, iter(pictures)))


def steps(scene: Fitted) -> Figure:
    """Matches of cells, their depths, the fields, what joining adds, depth before and after and true, and the mask."""
    from concepts import _depth, _image
    from matplotlib import pyplot

    from vggtjax.research.evaluation.metrics.depth import median_scale
    from vggtjax.results.previews import overlay

    cells, matched, weight, ratio = _matched(scene)
    predicted, fields, joined, true = scene.predicted, scene.fields, scene.joined, scene.truth.depth
    scaled = [of.depth * median_scale(of.depth, true) for of in (predicted, joined)]
    titles = ("1  matches,\n2 frames later", "2  depths of cells,\nmeasured", "3  fields",
              f"4  joining,\nx {_STRONGER}", "predicted depth", "depth found", "true depth", "5  mask")  # fmt: skip
    frames, side = (2, 5, 8), SIDE / cells.grid[1]
    figure, axes = pyplot.subplots(len(frames), len(titles), figsize=(11.5, 4.9), layout="constrained")
    drawn = {}
    for row, frame in zip(axes, frames, strict=True):
        changes = (np.log(fields.depth / predicted.depth), np.log(joined.depth / fields.depth))
        shown = (
            scene.pictures[frame],
            ratio[frame],
            changes[0][frame] - np.median(changes[0]),
            _STRONGER * changes[1][frame],
            *(_depth(values[frame], true) for values in (*scaled, true)),
            overlay(joined.images[frame], joined.dynamic_mask[frame]),
        )
        for column, (cell, picture, title) in enumerate(zip(row, shown, titles, strict=True)):
            how, label = _CHANGE if column in (1, 2, 3) else {}, f"frame {frame}" if column == 0 else ""
            drawn[column] = _image(cell, picture, title if frame == frames[0] else "", label, **how)
        start = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in cells.grid[::-1])), axis=-1).reshape(-1, 2)
        sure = weight[frame] > 0.3
        lines = np.stack([start[sure], matched[frame][sure]], axis=1).transpose(2, 1, 0)
        row[0].plot(*(lines * side - 0.5), color="#ffe94a", linewidth=0.7)
        row[0].set(xlim=(-0.5, SIDE - 0.5), ylim=(SIDE - 0.5, -0.5))
    figure.colorbar(drawn[1], ax=list(axes[:, 1:4].ravel()), location="bottom", label="change of log depth",
                    fraction=0.05, aspect=36, pad=0.03)  # fmt: skip
    return figure


def _matched(scene: Fitted) -> tuple[Cells, np.ndarray, np.ndarray, np.ndarray]:
    """Return the cells, their matches two frames later with weights, and the log of measured over predicted depth."""
    import dataclasses

    from vggtjax.cameras import Cameras
    from vggtjax.method.matching.matches import frame_pairs
    from vggtjax.pipeline.known.intrinsics import shared_focal
    from vggtjax.pipeline.refinement.cells import at_scale, cells_of, grey_pictures
    from vggtjax.pipeline.refinement.dense import PREDICTED, ROUNDS, adjust_to_pixels
    from vggtjax.pipeline.refinement.pixel_matches import expected_matches, match_pixels

    predicted = scene.predicted
    start = dataclasses.replace(predicted, intrinsics=shared_focal(predicted).astype(np.float32))
    cells = cells_of(start)
    grey = grey_pictures(predicted, iter(scene.pictures), cells.grid)
    world = adjust_to_pixels(cells, grey, PREDICTED)
    intrinsics = cells.cameras.intrinsics.copy()
    intrinsics[:, [0, 1], [0, 1]] *= world.focal
    expected, warp = expected_matches(world.depth, Cameras(world.camera_from_world, intrinsics), cells.grid)
    last = ROUNDS[-1]
    found = match_pixels(at_scale(grey, cells.grid, last.pixels), expected.astype(np.float32), warp, cells.grid,
                         last.window)  # fmt: skip
    later = frame_pairs(len(cells.depth)).offsets.index(2)
    ratio = np.where(world.information > _SURE, np.log(world.depth / cells.depth), np.nan)
    ratio = (ratio - np.nanmedian(ratio)).reshape(-1, *cells.grid)
    return cells, found.position[:, later], found.weight[:, later] * cells.is_static, ratio


def surfaces(scene: Fitted) -> Figure:
    """Static points of all frames from above, a colour for each frame: predicted, found, and true."""
    from matplotlib import pyplot

    from vggtjax.cameras import unproject
    from vggtjax.research.evaluation.metrics.depth import median_scale

    truth, still = scene.truth, ~scene.truth.dynamic_mask
    figure, axes = pyplot.subplots(1, 3, figsize=(11.5, 2.9), layout="constrained", sharex=True, sharey=True)
    height = truth.depth.shape[1]
    rows = slice(*(round(share * height) for share in _HEIGHTS))
    colours = pyplot.get_cmap("plasma")(np.linspace(0.1, 0.95, len(still)))
    for cell, (name, of) in zip(
        axes, {"predicted": scene.predicted, "found": scene.joined, "true": truth}.items(), strict=True
    ):
        scale = median_scale(of.depth, truth.depth)
        poses = np.array(of.camera_from_world, np.float64)
        poses[:, :, 3] *= scale
        depth = (of.depth * scale).astype(np.float32)
        points = unproject(depth, of.intrinsics, poses.astype(np.float32), pixel_offset=0.5)
        points = points @ poses[0, :, :3].T + poses[0, :, 3]  # as the first camera sees them
        points = (points - truth.camera_from_world[0, :, 3]) @ truth.camera_from_world[0, :, :3]
        for frame, colour in enumerate(colours):
            x, _, z = points[frame, rows][still[frame, rows]].T
            cell.scatter(z, x, s=0.7, color=colour, linewidths=0)
        cell.set(title=name, xlabel="metres")
        cell.set_aspect("equal", "box")
    shown = np.concatenate([np.asarray(each.get_offsets()) for each in axes[2].collections])
    low, high = np.percentile(shown, (0.5, 99.5), axis=0)
    (left, right), (below, above) = np.transpose([low - _MARGIN, high + _MARGIN])
    axes[0].set(ylabel="metres", xlim=(left, right), ylim=(below, above))
    return figure
