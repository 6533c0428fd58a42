"""Points followed from window to window: where two windows share frames, the next one takes the points over.

Does not import jax.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from vggtjax.clips.queries import Queries
from vggtjax.pipeline.windows.plan import blend_weights, shared_frames
from vggtjax.progress import Progress

_TAKEOVERS = 3  # frames in which a window takes points over, at most; each costs a run of the tracker
_SEEN = 0.5  # probability from which a point counts as visible
_LEAST_SURE = 1e-3  # of the product of probabilities that a position is weighed by


class Tracked(NamedTuple):
    """Points in every frame of a window, or of the clip."""

    positions: Float32[np.ndarray, "F Q 2"]  # x, y in pixels of the frames
    visibility: Float32[np.ndarray, "F Q"]  # probability that the point is visible
    confidence: Float32[np.ndarray, "F Q"]  # probability that the position is close to the truth


Images = Float32[np.ndarray, "F H W 3"]
Places = Float32[np.ndarray, "Q 2"]


class TrackStart(NamedTuple):
    """Points that the tracker follows together, from one frame of a window."""

    frame: int
    places: Places


Follow = Callable[[Images, Sequence[TrackStart]], Sequence[Tracked]]


class _Neighbour(NamedTuple):
    """A window whose points the next one takes over."""

    window: range
    points: Int64[np.ndarray, " T"]
    tracked: Tracked


def follow_points(
    queries: Queries,
    windows: Sequence[range],
    images_of: Callable[[int], Images],
    follow: Follow,
    into: Tracked,
    weights: Float32[np.ndarray, "S Q"],
    progress: Progress,
) -> None:
    """Follow points through all windows: on from the window that each is given in, and then back.

    A window takes a point over in a shared frame in which its neighbour sees it. In shared frames windows have a say by
    the distance from their ends, and in positions also by how sure they are that they see the point in its place.

    Args:
        queries: points in pixels of the clip's frames.
        windows: frames of each window, in order.
        images_of: the frames of a window by its number, RGB in [0, 1].
        follow: the tracker.
        into: arrays of zeros for all frames of the clip, which are filled.
        weights: an array of zeros, which is written over.
        progress: called with the number of steps that are done.
    """
    homes = np.array([_home(frame, windows) for frame in queries.frames.tolist()])
    back = range(int(homes.max()) - 1, -1, -1)
    of_home: dict[int, Tracked] = {}  # points in the window that they are given in
    done = 0

    def run(number: int, own: Int64[np.ndarray, " O"], neighbour: _Neighbour | None) -> _Neighbour:
        nonlocal done
        found = _in_window(queries, windows[number], own, neighbour, lambda starts: follow(images_of(number), starts))
        points = own if neighbour is None else np.concatenate([neighbour.points, own])
        for frame, (positions, visibility, confidence) in zip(windows[number], zip(*found, strict=True), strict=True):
            share = np.float32(blend_weights(frame, windows)[number])
            weight = share * np.maximum(visibility * confidence, _LEAST_SURE)
            into.positions[frame, points] += weight[:, None] * positions
            into.visibility[frame, points] += share * visibility
            into.confidence[frame, points] += share * confidence
            weights[frame, points] += weight
        progress(done := done + 1, len(windows) + len(back))
        return _Neighbour(windows[number], points, found)

    neighbour = None
    for number in range(len(windows)):
        own = np.flatnonzero(homes == number)
        neighbour = run(number, own, neighbour)
        if own.size:
            of_home[number] = Tracked(*(array[:, -len(own) :].copy() for array in neighbour.tracked))
    neighbour, nobody = None, np.zeros(0, np.int64)
    for number in back:
        if fresh := of_home.get(number + 1):
            points = np.flatnonzero(homes == number + 1)
            if neighbour is not None:
                points = np.concatenate([neighbour.points, points])
                pairs = zip(neighbour.tracked, fresh, strict=True)
                fresh = Tracked(*(np.concatenate(pair, axis=1) for pair in pairs))
            neighbour = _Neighbour(windows[number + 1], points, fresh)
        neighbour = run(number, nobody, neighbour)
    for positions, weight in zip(into.positions, weights, strict=True):
        positions /= weight[:, None]
    into.positions[queries.frames, np.arange(len(homes))] = queries.points


def _home(frame: int, windows: Sequence[range]) -> int:
    """Return the window in which a frame is the farthest from the ends."""
    weights = blend_weights(frame, windows)
    return max(weights, key=weights.__getitem__)


def _in_window(
    queries: Queries,
    window: range,
    own: Int64[np.ndarray, " O"],
    neighbour: _Neighbour | None,
    follow: Callable[[Sequence[TrackStart]], Sequence[Tracked]],
) -> Tracked:
    """Follow the points of a neighbour and a window's own ones through the window.

    Own points are followed with those of their frame, as in a clip that is run at once. All of the neighbour's points
    are followed from each frame in which some are taken over, so that the tracker is compiled once, and each is kept
    of its own frame.
    """
    starts: list[TrackStart] = []
    kept: list[tuple[np.ndarray, np.ndarray]] = []  # of each start: columns of the outputs, and where they go
    taken = 0
    if neighbour is not None:
        taken = len(neighbour.points)
        frames = _takeovers(neighbour, shared_frames(neighbour.window, window))
        for frame in np.unique(frames).tolist():
            starts.append(TrackStart(frame - window.start, neighbour.tracked.positions[frame - neighbour.window.start]))
            here = np.flatnonzero(frames == frame)
            kept.append((here, here))
    for frame in np.unique(queries.frames[own]).tolist():
        here = np.flatnonzero(queries.frames[own] == frame)
        starts.append(TrackStart(frame - window.start, queries.points[own[here]]))
        kept.append((np.arange(len(here)), taken + here))
    count = taken + len(own)
    shapes = ((len(window), count, 2), (len(window), count), (len(window), count))
    all_points = Tracked(*(np.zeros(shape, np.float32) for shape in shapes))
    if starts:
        for tracked, (columns, places) in zip(follow(starts), kept, strict=True):
            for array, values in zip(all_points, tracked, strict=True):
                array[:, places] = values[:, columns]
    return all_points


def _takeovers(neighbour: _Neighbour, shared: range) -> Int64[np.ndarray, " T"]:
    """Return the shared frame in which each point is taken over: at most three, in which as many as can be are seen.

    Points that none of them shows are taken over in the first of the three, where they are hidden.
    """
    first = neighbour.window.start
    seen = neighbour.tracked.visibility[shared.start - first : shared.stop - first] >= _SEEN
    frames = np.full(seen.shape[1], -1)
    for _ in range(_TAKEOVERS):
        fresh = seen & (frames < 0)
        best = int(fresh.sum(axis=1).argmax())
        frames[fresh[best]] = shared[best]
    frames[frames < 0] = shared[int(seen.sum(axis=1).argmax())]
    return frames
