"""A smooth field of log scale for each frame: depth is multiplied by its exponential, to fit measured depths robustly.

After the deformation fields of robust consistent video depth (Kopf, Rong, Huang 2021, arXiv 2012.05901), here fitted to
measured depths by their own precision. Does not import jax.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Float64, Int

_ANNEALED = (4, 3, 2, 1.5, 1, 1, 1, 1, 1, 1)  # the loss's scale is multiplied by this in each iteration


class Measured(NamedTuple):
    """Depths measured at places of a clip's frames."""

    frame: Int[np.ndarray, " N"]
    place: Float[np.ndarray, "N 2"]  # x, y in [0, 1] of the frame's width and height
    log_ratio: Float[np.ndarray, " N"]  # log of the measured depth over the clip's depth
    precision: Float[np.ndarray, " N"]  # inverse variance of the log ratio

    def of(self, chosen: Bool[np.ndarray, " N"]) -> Measured:
        """Return some of them."""
        return Measured(*(values[chosen] for values in self))


@dataclass(frozen=True)
class FieldPrior:
    """How far a field may go: standard deviations of log scale, and the loss's scale."""

    step: float = 0.2  # between neighbouring nodes of a grid of 12 x 12
    offset: float = 0.4  # of a node
    robust: float = 0.3  # scale of the Geman-McClure loss
    together: float = 4.0  # the measurements of a node's cell count as so many at most: their errors are alike
    nodes: int = 12  # along the frame's longer side

    @classmethod
    def of_error(cls, error: float) -> FieldPrior:
        """Return the prior for depth whose log has this standard deviation."""
        return cls(step=1.5 * error, offset=3 * error, robust=2.25 * error)


def fit_field(
    measured: Measured, frames: int, size: tuple[int, int], prior: FieldPrior
) -> Float64[np.ndarray, "S h w"]:
    """Return the log scale at the nodes of each frame; they lie on a grid from corner to corner.

    Args:
        measured: depths.
        frames: number of frames; those without measurements have a field of 0.
        size: height and width of a frame, in any unit.
        prior: how far the fields may go.
    """
    shape = grid_shape(size, prior.nodes)
    still = _stiffness(shape, prior)
    fields = np.zeros((frames, *shape))
    order = np.argsort(measured.frame, kind="stable")
    ends = np.searchsorted(measured.frame[order], np.arange(frames + 1))
    for frame in range(frames):
        rows = order[ends[frame] : ends[frame + 1]]
        if len(rows):
            fields[frame] = _fit(measured.of(rows), shape, still, prior).reshape(shape)
    return fields


def at_pixels(field: Float64[np.ndarray, "h w"], size: tuple[int, int]) -> Float64[np.ndarray, "H W"]:
    """Return a frame's field at the centres of pixels."""
    rows, columns = (_hat((np.arange(n) + 0.5) / n, k) for n, k in zip(size, field.shape, strict=True))
    return rows @ field @ columns.T


def grid_shape(size: tuple[int, int], nodes: int) -> tuple[int, int]:
    """Return rows and columns of a grid of nearly square cells with `nodes` along the longer side, at least 2."""
    longest = max(size)
    rows, columns = (max(2, round(1 + (nodes - 1) * side / longest)) for side in size)
    return rows, columns


def _fit(measured: Measured, shape: tuple[int, int], still: np.ndarray, prior: FieldPrior) -> np.ndarray:
    nodes, weights = _basis(measured.place, shape)
    number, ratio = len(still), measured.log_ratio
    cell = nodes[np.arange(len(nodes)), weights.argmax(axis=1)]
    crowd = np.bincount(cell, minlength=number)[cell]
    trust = measured.precision * np.minimum(1, prior.together / crowd)
    pairs = nodes[:, :, None] * number + nodes[:, None]
    products = weights[:, :, None] * weights[:, None]
    w, values = trust, np.zeros(number)
    for times in _ANNEALED:
        H = still + np.bincount(pairs.ravel(), (products * w[:, None, None]).ravel(), number**2).reshape(number, number)
        g = np.bincount(nodes.ravel(), (weights * (w * ratio)[:, None]).ravel(), number)
        values = scipy.linalg.solve(H, g, assume_a="pos")
        error = np.sum(values[nodes] * weights, axis=1) - ratio
        w = trust * (1 + (error / (times * prior.robust)) ** 2) ** -2
    return values


def _stiffness(shape: tuple[int, int], prior: FieldPrior) -> np.ndarray:
    """Return the precision of the nodes without measurements: of steps between neighbours, and of each."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    edges = [np.stack([a.ravel(), b.ravel()]) for a, b in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1]))]
    first, second = np.concatenate(edges, axis=1)
    H = np.diag(np.full(number.size, prior.offset**-2))
    steps = (12 - 1) / (max(shape) - 1)  # coarser grids step further
    stiff = 1 / (prior.step**2 * steps)
    for a, b, value in (
        (first, first, stiff),
        (second, second, stiff),
        (first, second, -stiff),
        (second, first, -stiff),
    ):
        np.add.at(H, (a, b), value)
    return H


def _basis(place: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the four nodes around each place, and their bilinear weights, [N, 4]."""
    at = np.clip(place, 0, 1) * (np.array(shape[::-1]) - 1)
    corner = np.minimum(at.astype(int), np.array(shape[::-1]) - 2)
    (column, row), (right, down) = corner.T, (at - corner).T
    nodes = np.stack([(row + i) * shape[1] + column + j for i in (0, 1) for j in (0, 1)], axis=1)
    weights = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
    return nodes, weights


def _hat(at: np.ndarray, nodes: int) -> np.ndarray:
    return np.maximum(0, 1 - np.abs(at[:, None] * (nodes - 1) - np.arange(nodes)))
