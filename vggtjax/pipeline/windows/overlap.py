"""Which frames show the place of others, and which of them are the best anchors. Does not import jax.

Every patch of a frame is looked for among those of another: the overlap is how alike the best ones are on average,
compared with patches of other places of one picture (0) and with the same picture (1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from vggtjax.pipeline.windows.plan import FEWEST_ANCHORS, SAME_PLACE

_MOST_PATCHES = 256  # of a frame, evenly spread
_ELSEWHERE = 1 / 3  # of a picture's width: so far away is another place
_SPREAD = 0.1  # what an anchor at the far end of the path counts for, compared with one that shows a new frame whole


def thinned(tokens: Float[np.ndarray, "F P C"], grid: tuple[int, int]) -> tuple[Float32[np.ndarray, "F N C"], int]:
    """Return at most 256 patches of each frame, every n-th row and column, and how many are in a row."""
    step = max(1, math.ceil(math.sqrt(grid[0] * grid[1] / _MOST_PATCHES)))
    kept = np.asarray(tokens, np.float32).reshape(len(tokens), *grid, -1)[:, ::step, ::step]
    return kept.reshape(len(tokens), -1, kept.shape[-1]), kept.shape[2]


class Places(NamedTuple):
    """The patches of frames, as directions from their mean, and how alike other places of one picture are."""

    mean: Float32[np.ndarray, " C"]
    patches: Float32[np.ndarray, "F N C"]
    floor: float

    @classmethod
    def of(cls, patches: Float32[np.ndarray, "F N C"], columns: int) -> Places:
        mean = patches.mean(axis=(0, 1))
        own = _directions(patches, mean)
        row, column = np.divmod(np.arange(own.shape[1]), columns)
        apart = np.maximum(abs(row[:, None] - row), abs(column[:, None] - column)) >= max(1, columns * _ELSEWHERE)
        floors = [np.where(apart, frame @ frame.T, -1).max(axis=1).mean() for frame in own]
        return cls(mean, own, float(np.median(floors)))

    def overlaps(
        self, patches: Float32[np.ndarray, "M N C"], known: Float32[np.ndarray, "K N C"] | None = None
    ) -> Float64[np.ndarray, "M K"]:
        """Return the overlap of frames with each of `known`, by default with these frames."""
        others = self.patches if known is None else _directions(known, self.mean)
        rows = [[(frame @ other.T).max(axis=1).mean() for other in others] for frame in _directions(patches, self.mean)]
        alike = np.array(rows, np.float64).reshape(len(patches), len(others))
        return (alike - self.floor) / max(1 - self.floor, 1e-6)


def choose_anchors(
    overlaps: Float64[np.ndarray, "M F"],
    centres: Float[np.ndarray, "F 3"],
    usable: Bool[np.ndarray, " F"],
    count: int,
    bound: float = SAME_PLACE,
) -> list[int]:
    """Return up to `count` frames that show the place of new ones, spread over the path.

    Each is the one that adds most to the mean overlap of the new frames with their best anchor, and to the spread of
    the anchors. With fewer than three frames that overlap enough, the next best are taken too.

    Args:
        overlaps: of the new frames with the known ones.
        centres: of the known frames' cameras.
        usable: known frames that show enough of what does not move; at least 3.
        count: of anchors, at least 3.
        bound: frames that overlap by less show another place.
    """
    best = np.where(usable, overlaps.max(axis=0), -np.inf)
    enough = int((best >= bound).sum())
    order = np.argsort(-best, kind="stable")
    candidates = order[: min(max(enough, FEWEST_ANCHORS), int(usable.sum()))]
    chosen: list[int] = []
    apart = np.linalg.norm(centres[candidates, None] - centres[None, candidates], axis=-1)
    apart /= max(float(apart.max()), 1e-12)
    covered = np.zeros(len(overlaps))
    for _ in range(min(count, len(candidates))):
        gain = np.maximum(overlaps[:, candidates] - covered[:, None], 0).mean(axis=0)
        gain += _SPREAD * (apart[:, chosen].min(axis=1) if chosen else 0)
        gain[chosen] = -1
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, overlaps[:, candidates[chosen[-1]]])
    return sorted(int(candidates[number]) for number in chosen)


def unconnected(placed: Bool[np.ndarray, " M"], alike: Bool[np.ndarray, "M M"]) -> list[int]:
    """Return the frames that are neither placed nor lead to placed ones over frames that show one place."""
    reached = placed
    while (more := reached | alike[:, reached].any(axis=1)).sum() > reached.sum():
        reached = more
    return np.flatnonzero(~reached).tolist()


def _directions(patches: Float32[np.ndarray, "F N C"], mean: Float32[np.ndarray, " C"]) -> Float32[np.ndarray, "F N C"]:
    away = patches - mean
    return away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
