"""A result that grows: windows of anchors and new frames, joined to it and to each other. Does not import jax.

The old result is node 0, the windows are nodes 1, 2, ...; all joins are solved together, and node 0 stays as it is.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial.transform import Rotation

from vggtjax.cameras import align, camera_centres, checked_centres
from vggtjax.clips.clip import Clip
from vggtjax.clips.fingerprint import source_setting
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.errors import InputError
from vggtjax.pipeline.windows.graph import IDENTITY, edge_of, solve_graph
from vggtjax.pipeline.windows.join import Join, join_windows, reach_of
from vggtjax.pipeline.windows.overlap import Places, choose_anchors, unconnected
from vggtjax.pipeline.windows.plan import FEWEST_ANCHORS
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import ARRAYS, TRACKS
from vggtjax.results.visible import show_points

_LEAST_STATIC = 0.02  # share of a frame's pixels; with less, an anchor says nothing of where it is
_WORST = 0.2  # residual of a join, relative to depth; with more, anchors and new frames do not fit together
_STACKED = tuple(name for name in ARRAYS if name not in {*TRACKS, "timestamps"})
_OF_CLIP = ("images", "source_size", "source_scale", "source_offset", "valid_box")
_TIMES = ("times", "first_time", "first_time_exact", "time_digits")
_LATEST = 1e12  # seconds since 1970


class PlaceError(InputError):
    """New frames that cannot be placed; `frames` are their names."""

    def __init__(self, message: str, frames: list[str]) -> None:
        super().__init__(message)
        self.frames = frames


class _Window(NamedTuple):
    """New frames that are run together with anchors, which come first."""

    result: Reconstruction
    frames: range  # the new frames, by number in the new clip
    anchors: list[tuple[int, int]]  # node, and number in it
    joins: dict[int, Join]  # that fit, by node
    overlaps: Float64[np.ndarray, " M"]  # of the new frames with their best known frame


class Growth:
    """The old result and the windows of new frames, while they are run and joined.

    Args:
        result: the old one.
        clip: the new frames.
        names: of the new frames in the joined result.
        known, new: patches of the frames of both, as `thinned` returns them.
        columns: patches in a row.
        bound: the least overlap of frames that show one place.
    """

    def __init__(
        self,
        result: Reconstruction,
        clip: Clip,
        names: list[str],
        known: Float32[np.ndarray, "F N C"],
        new: Float32[np.ndarray, "M N C"],
        columns: int,
        bound: float,
    ) -> None:
        self.clip, self.names, self._bound = clip, names, bound
        self.nodes: list[Reconstruction] = [result]
        self._windows: list[_Window] = []
        self._frames = [(0, frame) for frame in range(len(result.depth))]  # known ones: node, and number in it
        self._usable = _shows_static(result)
        self._centres = camera_centres(result.camera_from_world).astype(np.float64)
        self._worlds = [IDENTITY]  # along the best joins, until all are solved together
        places = Places.of(known, columns)
        self._overlaps, self._among = places.overlaps(new), places.overlaps(new, new)  # with known ones; of the new

    def next_part(self, parts: list[range], count: int) -> tuple[range, list[int]]:
        """Return the part that overlaps most with what is known, and its anchors, by number among the known frames.

        Raises PlaceError where no part shows the place, or frames of the part do not.
        """
        usable = int(self._usable.sum())
        if usable < FEWEST_ANCHORS:
            frames = f"{usable} of {len(self._usable)} known frames show"
            raise PlaceError(
                f"{frames} enough of what stands still to be anchors; at least {FEWEST_ANCHORS} are needed", self.names
            )
        best = np.where(self._usable, self._overlaps, -np.inf).max(axis=1)
        part = max(parts, key=lambda part: best[part.start : part.stop].max())
        inside = slice(part.start, part.stop)
        if best[inside].max() < self._bound:
            raise self._elsewhere([frame for each in parts for frame in each], usable < len(self._usable))
        if stray := unconnected(best[inside] >= self._bound, self._among[inside, inside] >= self._bound):
            raise self._elsewhere([part.start + number for number in stray])
        return part, choose_anchors(self._overlaps[inside], self._centres, self._usable, count, self._bound)

    def anchored(self, part: range, anchors: list[int]) -> Clip:
        """Return anchors and new frames as a clip; anchors are as if taken by the camera of the first new frame.

        Their pictures are those that the results store.
        """
        placed = [(self.nodes[node], number) for node, number in map(self._frames.__getitem__, anchors)]
        new, scale = slice(part.start, part.stop), self.clip.source_scale[part.start]
        size = np.maximum(np.round(scale[::-1] * self.clip.images.shape[1:3]), 1).astype(np.int64)

        def joined(name: str, of_anchors: list[Any]) -> np.ndarray:
            return np.concatenate([np.stack(of_anchors), getattr(self.clip, name)[new]])

        return dataclasses.replace(
            self.clip,
            images=joined("images", [result.images[number] / np.float32(255) for result, number in placed]),
            frame_names=[result.frame_names[number] for result, number in placed] + self.names[new],
            timestamps=None,
            source_size=joined("source_size", [size] * len(placed)),
            source_scale=joined("source_scale", [scale] * len(placed)),
            source_offset=joined("source_offset", [(0.0, 0.0)] * len(placed)),
            valid_box=joined("valid_box", [result.valid_box[number] for result, number in placed]),
        )

    def add(self, part: range, anchors: list[int], window: Reconstruction) -> None:
        """Join a window by its anchors. Raises PlaceError where none of its joins fits."""
        placed = [self._frames[anchor] for anchor in anchors]
        joins = {}
        for node in sorted({node for node, _ in placed}):
            pairs = [(frame, position) for position, (of, frame) in enumerate(placed) if of == node]
            joins[node] = join_windows(self.nodes[node], window, pairs)
        fits = {node: join for node, join in joins.items() if join.pixels and join.residual <= _WORST}
        if not fits:
            raise self._apart(part, list(joins.values()))
        best = min(fits, key=lambda node: fits[node].residual)
        new, number = slice(len(anchors), None), len(self.nodes)
        overlaps = self._overlaps[part.start : part.stop].max(axis=1)
        self._worlds.append(self._worlds[best].after(fits[best].similarity))
        self._windows.append(_Window(window, part, placed, fits, overlaps))
        self.nodes.append(window)
        self._frames += [(number, frame) for frame in range(len(anchors), len(window.depth))]
        self._usable = np.concatenate([self._usable, _shows_static(window)[new]])
        centres = checked_centres(align(window.camera_from_world[new], self._worlds[-1]))
        self._centres = np.concatenate([self._centres, centres])
        self._overlaps = np.concatenate([self._overlaps, self._among[:, part.start : part.stop]], axis=1)

    def result(self) -> Reconstruction:
        """Solve all joins together, and return the joined result."""
        joins = [(node, number, join) for number, w in enumerate(self._windows, 1) for node, join in w.joins.items()]
        usual, reaches = float(np.median([join.residual for *_, join in joins])), list(map(reach_of, self.nodes))
        edges = [edge_of(node, number, join.similarity, join.residual, usual) for node, number, join in joins]
        self._worlds = solve_graph(len(self.nodes), edges, reaches)
        old, times = self.nodes[0], _times(self.nodes[0], self.clip)
        settings = old.settings if times is not None else _without(old.settings, _TIMES)
        settings = settings | self._masks()  # that of the old result stays as it is
        earlier = settings.get("extended")
        windows = [self._facts(number, reaches[0]) for number in self._in_order()]
        facts = {"clip": self.clip.source.name, "first": len(old.depth), "frames": len(self.clip), "windows": windows}
        facts |= source_setting(self.clip.source)
        untracked = TRACKS - {"track_frames"} if old.track_frames is not None else ()
        return dataclasses.replace(
            old,
            **{name: self._stacked(name) for name in _STACKED},
            **{name: self._untracked(name) for name in untracked},
            frame_names=(*old.frame_names, *self.names),
            timestamps=times,
            settings=settings | {"extended": [*(earlier if isinstance(earlier, list) else []), facts]},
            passes=None,
        )

    def _in_order(self) -> list[int]:
        """Return the numbers of the windows in the order of their frames."""
        return sorted(range(len(self._windows)), key=lambda number: self._windows[number].frames.start)

    def _masks(self) -> dict[str, str]:
        """Return how the masks of old and new frames were made, as a setting, where these differ."""
        old = str(self.nodes[0].settings.get("masks", "made elsewhere"))
        ways = dict.fromkeys(str(window.result.settings.get("masks", "made elsewhere")) for window in self._windows)
        added = [f"{way} in added frames" for way in ways if way != old]
        added = [way for way in added if way not in old]
        return {"masks": "; ".join([old, *added])} if added else {}

    def _stacked(self, name: str) -> np.ndarray | None:
        """Return a field of the old frames, and of the new ones in the world of the old."""
        old = getattr(self.nodes[0], name)
        if old is None:
            return None
        parts = [old]
        if name in _OF_CLIP:
            new = getattr(self.clip, name)
            parts.append(in_bytes(new) if name == "images" else new)
        else:
            for number in self._in_order():
                window, world = self._windows[number], self._worlds[number + 1]
                value = getattr(window.result, name)
                if value is None:  # a window without motion: as the median everywhere
                    value = np.ones((len(window.result.depth), *old.shape[1:]), old.dtype)
                value = value[len(window.anchors) :]
                value = world.scale * value if name == "depth" else value
                parts.append(align(value, world) if name == "camera_from_world" else value)
        return np.concatenate([np.asarray(part, old.dtype) for part in parts])

    def _untracked(self, name: str) -> np.ndarray:
        old = getattr(self.nodes[0], name)
        return np.concatenate([old, np.zeros((len(self.clip), *old.shape[1:]), old.dtype)])

    def _facts(self, number: int, reach: float) -> dict[str, Any]:
        """Return how well the anchors of a window agree, as JSON values; distances relative to the median depth."""
        window, world = self._windows[number], self._worlds[number + 1]
        poses = [self.nodes[n].camera_from_world[frame][None] for n, frame in window.anchors]
        before = np.concatenate(
            [align(pose, self._worlds[n]) for pose, (n, _) in zip(poses, window.anchors, strict=True)]
        )
        after = align(window.result.camera_from_world[: len(poses)], world)
        turned = Rotation.from_matrix(after[:, :, :3] @ before[:, :, :3].swapaxes(1, 2)).magnitude()
        moved = np.linalg.norm(checked_centres(after) - checked_centres(before), axis=1) / reach
        return {
            "frames": [window.frames.start, window.frames.stop],
            "overlaps": window.overlaps.round(2).tolist(),
            "anchors": [self.nodes[n].frame_names[frame] for n, frame in window.anchors],
            "degrees": round(float(np.degrees(np.median(turned))), 3),
            "distance": round(float(np.median(moved)), 4),
            "residuals": {str(n): round(join.residual, 5) for n, join in window.joins.items()},
        }

    def _elsewhere(self, frames: list[int], some_move: bool = False) -> PlaceError:
        best = max(float(self._overlaps[frames].max()), 0.0)
        names = [self.names[frame] for frame in frames]
        if some_move and best >= self._bound:
            return PlaceError(
                f"nearly everything moves on the known frames that overlap with {_listed(names)}; leave the new frames "
                "out, or add frames that overlap with other known frames",
                names,
            )
        return PlaceError(
            f"no known frame shows the place of {_listed(names)}: the largest overlap is {best:.2f}; expected at least "
            f"{self._bound:g}; leave them out, or add frames in between",
            names,
        )

    def _apart(self, part: range, joins: list[Join]) -> PlaceError:
        names = self.names[part.start : part.stop]
        if not any(join.pixels for join in joins):
            reason = "their anchors show too little that stands still in both"
        else:
            residual = min(join.residual for join in joins if join.pixels)
            reason = f"depth and cameras of their anchors differ by {residual:.0%} of the depth, more than {_WORST:.0%}"
        return PlaceError(f"{_listed(names)} cannot be joined: {reason}", names)


def _listed(names: list[str]) -> str:
    return f"the new frame {names[0]}" + (f" and {len(names) - 1} more" if len(names) > 1 else "")


def _shows_static(result: Reconstruction) -> Bool[np.ndarray, " S"]:
    """Return the frames of which enough is known and stands still."""
    fields = (result.depth, result.depth_confidence, result.inside_pictures, result.dynamic_mask)
    shares = [(show_points(*known) & ~moving).mean() for *known, moving in zip(*fields, strict=True)]
    return np.array(shares) >= _LEAST_STATIC


def _times(result: Reconstruction, clip: Clip) -> Float64[np.ndarray, " S"] | None:
    """Return the times of all frames where both have those of one clock, and the new ones are later; else None."""
    times, first = getattr(clip.source, "times", None), result.settings.get("first_time")
    if result.timestamps is None or clip.timestamps is None or times is None:
        return None
    if not isinstance(first, float | int) or abs(first) > _LATEST:
        return None
    new = clip.timestamps + (float(times.first) - first)
    return np.concatenate([result.timestamps, new]) if new[0] > result.timestamps[-1] else None


def _without(settings: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in names}
