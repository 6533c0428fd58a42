"""The windows of a clip -> one result of the whole clip: joins, loops, one world, blended frames.

One or two windows are in memory at a time; the arrays of the whole clip are mapped files. Does not import jax.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from vggtjax.cameras import Similarity
from vggtjax.clips.clip import Clip
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.queries import Queries
from vggtjax.pipeline.windows.blend import WindowView, blend_frame
from vggtjax.pipeline.windows.frames import clip_of
from vggtjax.pipeline.windows.graph import LEAST_RESIDUAL, Edge, edge_of, solve_graph
from vggtjax.pipeline.windows.join import Join, join_windows, reach_of
from vggtjax.pipeline.windows.loops import Loop, described_frames, find_loops, frames_around
from vggtjax.pipeline.windows.plan import blend_weights, shared_frames
from vggtjax.pipeline.windows.store import WindowStore
from vggtjax.pipeline.windows.tracks import Follow, Tracked, follow_points
from vggtjax.progress import OnStage, Progress, no_progress, no_stage
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import ARRAYS

_LOOPS = 0.5  # tried, at most, for each window
_WORSE = 2.0  # times the usual residual of neighbours; a loop window that fits worse shows another place
_WORST = 0.2  # residual of a loop, relative to depth

NO_TRACKS: Mapping[str, np.ndarray] = MappingProxyType({})

logger = logging.getLogger(__name__)

_BLENDED = ("depth", "depth_confidence", "saliency", "motion", "dynamic_mask", "camera_from_world", "intrinsics")
_COPIED = ("images", "timestamps", "source_size", "source_scale", "source_offset", "valid_box")


class TriedLoop(NamedTuple):
    """A loop that a window of its own was run for."""

    loop: Loop
    residual: float  # the larger of the joins to both sides
    used: bool


@dataclass
class Whole:
    """A clip whose windows are all in the store, by their numbers."""

    store: WindowStore
    windows: Sequence[range]
    run: Callable[[Clip], Reconstruction]  # for windows that verify loops
    on_stage: OnStage = no_stage
    joins: list[Join] = field(default_factory=list)
    loops: list[TriedLoop] = field(default_factory=list)

    def tracks(self, queries: Queries, follow: Follow, progress: Progress | None) -> dict[str, np.ndarray]:
        """Follow points through the windows, and return the fields of the whole result; they are mapped files."""
        frames, points = self.windows[-1].stop, len(queries.frames)
        shapes: dict[str, tuple[int, ...]] = {"track_positions": (frames, points, 2)}
        shapes |= dict.fromkeys(("track_visibility", "track_confidence", "weights"), (frames, points))
        arrays = self.store.arrays({name: (np.dtype(np.float32), shape) for name, shape in shapes.items()})
        weights = arrays.pop("weights")

        def images_of(number: int) -> Float32[np.ndarray, "F H W 3"]:
            return self.store.load(window_name(number)).images / np.float32(255)

        into = Tracked(*(arrays[f"track_{name}"] for name in Tracked._fields))
        follow_points(queries, self.windows, images_of, follow, into, weights, progress or no_progress)
        return {**arrays, "track_frames": queries.frames}

    def result(self, like: Clip, *, loops: bool, tracks: Mapping[str, np.ndarray] = NO_TRACKS) -> Reconstruction:
        """Return the whole clip; its large arrays are mapped files of the store."""
        edges, reaches = self._neighbours()
        if loops:
            edges += self._loop_edges(like)
        worlds = solve_graph(len(self.windows), edges, reaches)
        return self._blended(worlds, tracks)

    def facts(self) -> dict[str, Any]:
        """Return what is told of the windows in the settings of the result, as JSON values."""
        return {
            "count": len(self.windows),
            "residuals": [round(join.residual, 5) for join in self.joins],
            "static_pixels": [join.pixels for join in self.joins],
            "loops": [
                {
                    "frames": [tried.loop.first_frame, tried.loop.second_frame],
                    "likeness": round(tried.loop.likeness, 4),
                    "residual": round(tried.residual, 5),
                    "used": tried.used,
                }
                for tried in self.loops
            ],
        }

    def _neighbours(self) -> tuple[list[Edge], list[float]]:
        """Return the edges between neighbours, and the reach of each window."""
        edges, reaches = [], []
        last: Reconstruction | None = None
        with self.on_stage("join windows") as progress:
            for number, window in enumerate(self.windows):
                here = self.store.load(window_name(number))
                reaches.append(reach_of(here))
                if last is not None:
                    before = self.windows[number - 1]
                    shared = shared_frames(before, window)
                    join = join_windows(last, here, [(f - before.start, f - window.start) for f in shared])
                    if not join.pixels:
                        logger.warning(
                            "windows %d and %d, which share frames %d to %d, share no static pixels to be joined by; "
                            "they are joined by their cameras, and in scale by all pixels",
                            number - 1, number, shared.start, shared.stop - 1,
                        )  # fmt: skip
                    self.joins.append(join)
                last = here
                (progress or no_progress)(number + 1, len(self.windows))
        usual = self._usual()
        for number, join in enumerate(self.joins):
            edges.append(edge_of(number, number + 1, join.similarity, join.residual, usual))
        return edges, reaches

    def _usual(self) -> float:
        return max(float(np.median([join.residual for join in self.joins])), LEAST_RESIDUAL)

    def _loop_edges(self, like: Clip) -> list[Edge]:
        """Return edges between windows that show one place again, each verified by a window of its own."""
        names = [window_name(number) for number in range(len(self.windows))]
        features = self.store.features(names, len(described_frames(self.windows[0])))
        found = find_loops(features, self.windows, max(1, round(_LOOPS * len(self.windows))))
        edges = []
        with self.on_stage("close loops") as progress:
            for number, loop in enumerate(found):
                edge = self._verified(loop, like)
                edges += [] if edge is None else [edge]
                (progress or no_progress)(number + 1, len(found))
        return edges

    def _verified(self, loop: Loop, like: Clip) -> Edge | None:
        """Return how the two windows of a loop lie to each other, by a window with frames of both; None if they do not.

        That window is run by the method as it is, and joined to both.
        """
        length = len(self.windows[loop.first])
        first, second = self.windows[loop.first], self.windows[loop.second]
        half = length // 2
        of_first = frames_around(loop.first_frame, first, half)
        of_second = frames_around(loop.second_frame, second, length - half)
        a, b = (self.store.load(window_name(number)) for number in (loop.first, loop.second))
        frames = [(a, f - first.start) for f in of_first] + [(b, f - second.start) for f in of_second]
        clip = clip_of(frames, like)
        name = f"loop-{loop.first_frame:06d}-{loop.second_frame:06d}"
        between = self.store.find(name, clip.frame_names, in_bytes(clip.images))
        if between is None:
            between = self.run(clip)
            self.store.save(name, between)
        to_first = join_windows(a, between, [(f - first.start, i) for i, f in enumerate(of_first)])
        to_second = join_windows(b, between, [(f - second.start, half + i) for i, f in enumerate(of_second)])
        worst, usual = max(to_first.residual, to_second.residual), self._usual()
        used = bool(to_first.pixels and to_second.pixels) and worst <= min(_WORSE * usual, _WORST)
        self.loops.append(TriedLoop(loop, worst, used))
        if not used:
            return None
        between_both = to_first.similarity.after(to_second.similarity.inverse())
        return edge_of(loop.first, loop.second, between_both, worst, usual)

    def _blended(self, worlds: Sequence[Similarity], tracks: Mapping[str, np.ndarray]) -> Reconstruction:
        """Return the result, written frame by frame into mapped files; windows are loaded when frames need them."""
        total = self.windows[-1].stop
        first = self.store.load(window_name(0))
        shapes = {
            name: (ARRAYS[name][0], (total, *getattr(first, name).shape[1:]))
            for name in (*_BLENDED, *_COPIED)
            if getattr(first, name) is not None
        }
        if first.saliency is not None:  # windows whose matches cannot be used have no motion
            shapes["motion"] = shapes["saliency"]
        arrays: dict[str, np.ndarray] = dict(self.store.arrays(shapes))
        names: list[str] = []
        held: dict[int, Reconstruction] = {}
        masked_by: dict[int, str] = {}
        is_matched = False
        with self.on_stage("blend windows") as progress:
            for frame in range(total):
                weights = blend_weights(frame, self.windows)
                held = {n: held[n] if n in held else self.store.load(window_name(n)) for n in weights}
                masked_by |= {n: str(window.settings.get("masks")) for n, window in held.items()}
                views = [WindowView(held[n], frame - self.windows[n].start, worlds[n], w) for n, w in weights.items()]
                blended = blend_frame(views)
                for name in _BLENDED:
                    if name in arrays:
                        value = getattr(blended, name)
                        arrays[name][frame] = 1 if value is None else value
                is_matched |= blended.motion is not None
                source, number = views[0].result, views[0].number
                for name in _COPIED:
                    if name in arrays:
                        arrays[name][frame] = getattr(source, name)[number]
                names.append(source.frame_names[number])
                (progress or no_progress)(frame + 1, total)
        if not is_matched:
            arrays.pop("motion", None)
        fields: dict[str, Any] = {"saliency": None, "timestamps": None, **arrays, **tracks}
        settings = first.settings | {"windows": self.facts()}
        if len(ways := Counter(masked_by.values())) > 1:
            settings["masks"] = "; ".join(f"{way} ({n} of {len(masked_by)} windows)" for way, n in ways.most_common())
        return Reconstruction(
            **fields, frame_names=tuple(names), method=first.method, model_name=first.model_name, settings=settings
        )


def window_name(number: int) -> str:
    """Return the name of a window in the store."""
    return f"{number:04d}"


def store_window(
    number: int,
    clip: Clip,
    window: range,
    store: WindowStore,
    run: Callable[[Clip], Reconstruction],
    describe: Callable[[Float32[np.ndarray, "F H W 3"]], Float32[np.ndarray, "F C"]],
) -> None:
    """Run, describe and store a window, unless it is stored already."""
    name = window_name(number)
    if store.find(name, clip.frame_names, in_bytes(clip.images)) is None:
        described = [frame - window.start for frame in described_frames(window)]
        store.save(name, run(clip), describe(clip.images[described]))
