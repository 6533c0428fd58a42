"""Places that the camera comes back to: pairs of frames that look alike, in windows far apart. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_NEAR = 2  # windows: a loop beside one that is found already says nothing new


class Loop(NamedTuple):
    """Two frames that may show one place, of windows a window or more apart."""

    first: int  # number of the window
    second: int
    first_frame: int  # number in the clip
    second_frame: int
    likeness: float


def described_frames(window: range, count: int = 4) -> list[int]:
    """Return the frames of a window, by number in the clip, that are described for finding loops."""
    return [window[round(i)] for i in np.linspace(0, len(window) - 1, 2 * count + 1)[1::2]]


def find_loops(features: Sequence[Float[np.ndarray, "F C"]], windows: Sequence[range], most: int) -> list[Loop]:
    """Return pairs of frames of different windows that look alike, the most alike first.

    Features are compared by their angle, after the clip's mean is taken out: what all frames share says nothing. As
    alike as those of one loop are at least half of the pairs of described frames of neighbouring windows, which show
    one place. Windows less than a window apart are left out: the joins between them have little drift to take back.

    Args:
        features: of each window's `described_frames`.
        windows: the frames of each window.
        most: loops to return; of loops between the same or neighbouring windows only the best.
    """
    rows = np.concatenate(features).astype(np.float64)
    rows -= rows.mean(axis=0)
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
    owner = np.repeat(np.arange(len(windows)), [len(part) for part in features])
    frames = np.concatenate([described_frames(w, len(part)) for w, part in zip(windows, features, strict=True)])
    likeness = rows @ rows.T
    apart = owner[None] - owner[:, None]
    known = likeness[apart == 1]
    if not len(known):
        return []
    far = np.array([[b.start >= a.stop + len(a) for b in windows] for a in windows])
    pairs = np.argwhere(far[owner[:, None], owner[None]] & (likeness >= np.median(known)))
    order = np.argsort(-likeness[pairs[:, 0], pairs[:, 1]], kind="stable")
    found: list[Loop] = []
    for i, j in pairs[order]:
        a, b = int(owner[i]), int(owner[j])
        if any(abs(loop.first - a) <= _NEAR and abs(loop.second - b) <= _NEAR for loop in found):
            continue
        found.append(Loop(a, b, int(frames[i]), int(frames[j]), float(likeness[i, j])))
        if len(found) == most:
            break
    return found


def frames_around(frame: int, window: range, count: int) -> range:
    """Return `count` frames of a window, with `frame` as near to their middle as the window allows."""
    start = min(max(frame - count // 2, window.start), window.stop - count)
    return range(start, start + count)
