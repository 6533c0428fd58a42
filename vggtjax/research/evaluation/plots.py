"""Pictures of a sequence's scores, with matplotlib: paths, error maps, masks, histograms, calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vggtjax.results.previews import color_depth, inverse_depth_range, overlay
from vggtjax.storage.writing import writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curves = Mapping[str, Mapping[str, np.ndarray]]  # by method
_MOST_ERROR = 0.5  # relative error of depth at full colour
_DPI = 110
_UNKNOWN = "#6f7480"  # colour of pixels without true depth


def draw_sequence(folder: Path, curves: Curves) -> list[tuple[str, str]]:
    """Draw the plots of a sequence that its methods have curves for; return file names in `folder` and titles."""
    drawn = []
    for name, (title, needs, draw) in PLOTS.items():
        complete = {method: own for method, own in curves.items() if needs <= set(own)}
        if complete:
            with writing(folder / f"{name}.png") as path:
                draw(complete).savefig(path, dpi=_DPI)
            drawn.append((f"{name}.png", title))
    return drawn


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a width and height in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def add_legend(figure: Figure, columns: int) -> None:
    """Add the legend of the first axes below the figure."""
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=columns, frameon=False)


def _show_pictures(figure: Any, rows: Mapping[str, Iterable[np.ndarray]], shown: np.ndarray) -> np.ndarray:
    """Draw a row of pictures for each name, a column for each shown frame; return the axes."""
    grid = figure.subplots(len(rows), len(shown), squeeze=False)
    for axis, frame in zip(grid[0], shown, strict=True):
        axis.set_title(f"frame {frame}", fontsize=9)
    for axes, (name, pictures) in zip(grid, rows.items(), strict=True):
        axes[0].set_ylabel(name, fontsize=9)
        for axis, picture in zip(axes, pictures, strict=True):
            axis.imshow(picture, vmin=0, vmax=_MOST_ERROR, cmap="magma")  # pictures with three channels ignore these
            axis.set(xticks=[], yticks=[], facecolor=_UNKNOWN)
    return grid


def _paths(curves: Curves) -> Figure:
    """Draw the camera centres from above and from the side, in the plane of their greatest spread."""
    true = next(iter(curves.values()))["true_centres"]
    middle = true.mean(axis=0)
    axes = np.linalg.svd(true - middle)[2]  # first along the path, last across it
    figure = new_figure(9, 4)
    for column, (across, labels) in enumerate(((1, ("first", "second")), (2, ("first", "third")))):
        axis = figure.add_subplot(1, 2, column + 1)
        ways = {"truth": true} | {method: own["centres"] for method, own in curves.items()}
        for method, centres in ways.items():
            x, y = (centres - middle) @ axes[0], (centres - middle) @ axes[across]
            style: dict[str, Any] = {"color": "black", "linewidth": 2.5} if method == "truth" else {"linewidth": 1.2}
            axis.plot(x, y, marker=".", label=method, **style)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set(xlabel=f"{labels[0]} principal axis", ylabel=labels[1])
        axis.grid(alpha=0.3)
    add_legend(figure, 6)
    return figure


def _error_maps(curves: Curves) -> Figure:
    """Draw pictures, true depth and the relative error of each method's depth."""
    first = next(iter(curves.values()))
    shown, true = first["shown"], first["true_depth"]
    known = true > 0
    inverse_range = inverse_depth_range(true, known)
    coloured = [color_depth(d, k, inverse_range) for d, k in zip(true, known, strict=True)]
    rows = {"picture": first["images"], "true depth": coloured}
    rows |= {method: own["error_maps"].astype(np.float32) for method, own in curves.items()}
    height, width = true.shape[1:]
    figure = new_figure(2.6 * len(shown) + 1.2, 2.6 * height / width * len(rows) + 0.4)
    grid = _show_pictures(figure, rows, shown)
    figure.colorbar(grid[-1, 0].images[0], ax=grid[2:], label="relative error", shrink=0.8)
    return figure


def _masks(curves: Curves) -> Figure:
    """Draw J of every frame, and below it true and predicted masks over some of the pictures."""
    first = next(iter(curves.values()))
    shown = first["shown"]
    masks = {"truth": first["true_masks"]} | {method: own["masks"] for method, own in curves.items()}
    rows = {name: map(overlay, first["images"], own) for name, own in masks.items()}
    height, width = first["true_masks"].shape[1:]
    figure = new_figure(2.6 * len(shown) + 0.8, 2.4 + 2.6 * height / width * len(rows))
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[2.4, 2.6 * height / width * len(rows)]))
    axis = top.subplots()
    for method, own in curves.items():
        axis.plot(own["j"], marker=".", label=f"{method}")
    axis.set(xlabel="frame", ylabel="J", ylim=(0, 1))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=3, frameon=False)
    _show_pictures(bottom, rows, shown)
    return figure


def _distances(curves: Curves) -> Figure:
    """Draw the distances of points to the nearest points of the other cloud."""
    figure = new_figure(9, 3.4)
    titles = {"accuracy": "accuracy: predicted to true", "completeness": "completeness: true to predicted"}
    for axis, (kind, title) in zip(figure.subplots(1, 2), titles.items(), strict=True):
        for method, own in curves.items():
            axis.stairs(own[kind] / max(own[kind].sum(), 1), own["distance_bins"], label=method)
        axis.set(xscale="log", xlabel="distance", ylabel="share of points", title=title)
        axis.grid(alpha=0.3)
    add_legend(figure, 5)
    return figure


def _calibration(curves: Curves) -> Figure:
    """Draw how well confidence orders errors (sparsification) and states their size (reliability)."""
    figure = new_figure(9, 3.8)
    left, right = figure.subplots(1, 2)
    for number, (method, own) in enumerate(curves.items()):
        removed, kept, oracle = own["sparsification"]
        left.plot(removed, kept, color=f"C{number}", label=method)
        left.plot(removed, oracle, color=f"C{number}", linestyle=":", linewidth=1)
        levels, plain, calibrated = own["reliability"]
        right.plot(levels, calibrated, color=f"C{number}", label=method)
        right.plot(levels, plain, color=f"C{number}", linestyle=":", linewidth=1)
    left.set(xlabel="share of least confident pixels removed", ylabel="mean error of the rest", ylim=(0, None))
    left.set_title("sparsification (dotted: by true error)", fontsize=10)
    right.plot([0, 1], [0, 1], color="black", linewidth=1)
    right.set(xlabel="stated probability", ylabel="share of errors within", xlim=(0, 1), ylim=(0, 1))
    right.set_title("reliability after one scale (dotted: before)", fontsize=10)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    add_legend(figure, 5)
    return figure


# File name -> title, required curves, and function that draws the plot.
PLOTS: dict[str, tuple[str, set[str], Callable[[Curves], Figure]]] = {
    "paths": ("Camera paths after Sim(3)", {"centres", "true_centres"}, _paths),
    "depth": ("Depth", {"error_maps", "true_depth", "images", "shown"}, _error_maps),
    "masks": ("Dynamic masks", {"j", "masks", "true_masks", "images", "shown"}, _masks),
    "distances": ("Distances between point clouds", {"distance_bins", "accuracy", "completeness"}, _distances),
    "calibration": ("Confidence", {"sparsification", "reliability"}, _calibration),
}
