"""Similarities between pairs of windows -> the similarity of each window to the whole, all solved together.

Does not import jax.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from vggtjax.cameras import Similarity
from vggtjax.errors import InputError

_FREEDOM = 7  # logarithm of the scale, rotation vector, translation
_OUTLIER = 0.1  # relative: an edge that asks for much more of the others loses its say
_SETTLED, _MOST_ROUNDS = 1e-9, 100
_STEP = 1e-5  # of numerical derivatives
LEAST_RESIDUAL = 0.005  # of joins, relative to depth: smaller ones do not tell a better join
IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


class Edge(NamedTuple):
    """How the world of the window `second` lies in that of the window `first`."""

    first: int
    second: int
    similarity: Similarity  # second -> first
    weight: float = 1.0


def edge_of(first: int, second: int, similarity: Similarity, residual: float, usual: float) -> Edge:
    """Return an edge whose weight is the greater the better its join fits, compared with the usual one."""
    return Edge(first, second, similarity, max(usual, LEAST_RESIDUAL) / max(residual, LEAST_RESIDUAL))


class _Batch(NamedTuple):
    """Similarities as arrays."""

    scale: Float64[np.ndarray, " N"]
    rotation: Float64[np.ndarray, "N 3 3"]
    translation: Float64[np.ndarray, "N 3"]

    def take(self, numbers: np.ndarray) -> _Batch:
        return _Batch(*(part[numbers] for part in self))

    def inverse(self) -> _Batch:
        rotation = self.rotation.swapaxes(1, 2)
        return _Batch(
            1 / self.scale, rotation, -np.einsum("nij,nj->ni", rotation, self.translation) / self.scale[:, None]
        )

    def after(self, first: _Batch) -> _Batch:
        moved = self.scale[:, None] * np.einsum("nij,nj->ni", self.rotation, first.translation) + self.translation
        return _Batch(self.scale * first.scale, self.rotation @ first.rotation, moved)


def solve_graph(count: int, edges: Sequence[Edge], reaches: Sequence[float]) -> list[Similarity]:
    """Return the similarity of each window's world to that of window 0.

    The squared differences between the edges and what the windows' similarities say of them are least: differences of
    the logarithm of scale, of rotation in radians, and of translation over the window's reach, which are the logarithm
    in Sim(3) to first order. Beyond a tenth they count by their logarithm (Cauchy's loss), so that a wrong loop cannot
    bend everything.
    Without a loop the edges are chained, exactly.

    Args:
        count: of windows.
        edges: between windows; they connect all windows.
        reaches: a length in each window's own world, such as its median depth, which translations are measured in.

    Raises InputError where the edges do not connect all windows.
    """
    start = _chained(count, edges)
    if len(edges) < count:
        return start
    ends = np.array([(edge.first, edge.second) for edge in edges])
    unit = np.asarray(reaches, np.float64)[:, None]
    measured = _batch([edge.similarity for edge in edges]).inverse()
    weights = np.array([edge.weight for edge in edges])[:, None]
    worlds = _batch(start)

    def differences(
        first: Float64[np.ndarray, "E 7"], second: Float64[np.ndarray, "E 7"]
    ) -> Float64[np.ndarray, "E 7"]:
        """Return the weighted differences of all edges, after steps of the windows at their ends."""
        one, other = (
            worlds.take(ends[:, end]).after(_exponential(step, unit[ends[:, end]]))
            for end, step in enumerate((first, second))
        )
        found = measured.after(one.inverse().after(other))
        turned = Rotation.from_matrix(found.rotation).as_rotvec()
        return weights * np.concatenate([np.log(found.scale)[:, None], turned, found.translation / unit[ends[:, 1]]], 1)

    for _ in range(_MOST_ROUNDS):
        still = np.zeros((len(edges), _FREEDOM))
        error = differences(still, still)
        slopes = np.empty((len(edges), _FREEDOM, 2 * _FREEDOM))  # of the differences, by the steps of both ends
        for column in range(_FREEDOM):
            step = still.copy()
            step[:, column] = _STEP
            slopes[:, :, column] = (differences(step, still) - differences(-step, still)) / (2 * _STEP)
            slopes[:, :, _FREEDOM + column] = (differences(still, step) - differences(still, -step)) / (2 * _STEP)
        trust = 1 / np.sqrt(1 + (error**2).sum(axis=1) / _OUTLIER**2)  # Cauchy's loss
        steps = _least_squares(count, ends, slopes * trust[:, None, None], error * trust[:, None])
        worlds = worlds.after(_exponential(steps, unit))
        if np.abs(steps).max() < _SETTLED:
            break
    return [Similarity(float(scale), rotation, moved) for scale, rotation, moved in zip(*worlds, strict=True)]


def _exponential(steps: Float64[np.ndarray, "N 7"], unit: Float64[np.ndarray, "N 1"]) -> _Batch:
    """Return the similarities of steps: logarithm of scale, rotation vector, translation in a unit."""
    return _Batch(np.exp(steps[:, 0]), Rotation.from_rotvec(steps[:, 1:4]).as_matrix(), steps[:, 4:] * unit)


def _least_squares(
    count: int, ends: Int[np.ndarray, "E 2"], slopes: Float64[np.ndarray, "E 7 14"], error: Float64[np.ndarray, "E 7"]
) -> Float64[np.ndarray, "N 7"]:
    """Return the steps of all windows that take the errors away as well as can be; window 0 stays."""
    rows = np.arange(error.size).reshape(-1, _FREEDOM, 1)
    columns = (_FREEDOM * ends[:, :, None] + np.arange(_FREEDOM)).reshape(-1, 1, 2 * _FREEDOM)
    places = np.broadcast_arrays(rows, columns)
    shape = (error.size, _FREEDOM * count)
    matrix = csr_matrix((slopes.ravel(), [place.ravel() for place in places]), shape)[:, _FREEDOM:]
    free = np.asarray(spsolve((matrix.T @ matrix).tocsc(), -(matrix.T @ error.ravel())))
    return np.concatenate([np.zeros((1, _FREEDOM)), free.reshape(-1, _FREEDOM)])


def _chained(count: int, edges: Sequence[Edge]) -> list[Similarity]:
    """Return the similarities along a tree of edges from window 0: those given first before others, so loops last."""
    tree: list[list[tuple[int, Similarity]]] = [[] for _ in range(count)]
    group = list(range(count))
    for edge in edges:
        one, other = group[edge.first], group[edge.second]
        if one != other:
            group = [one if number == other else number for number in group]
            tree[edge.first].append((edge.second, edge.similarity))
            tree[edge.second].append((edge.first, edge.similarity.inverse()))
    found: dict[int, Similarity] = {0: IDENTITY}
    waiting = deque([0])
    while waiting:
        number = waiting.popleft()
        for other, between in tree[number]:
            if other not in found:
                found[other] = found[number].after(between)
                waiting.append(other)
    if len(found) < count:
        lost = next(number for number in range(count) if number not in found)
        raise InputError(f"window {lost} is joined to no other; expected joins that connect all {count} windows")
    return [found[number] for number in range(count)]


def _batch(similarities: Sequence[Similarity]) -> _Batch:
    return _Batch(
        *(np.stack([np.asarray(part, np.float64) for part in parts]) for parts in zip(*similarities, strict=True))
    )
