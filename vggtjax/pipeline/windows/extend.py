"""A finished result and new frames of its place -> a result of both, in the frame and scale of the old one.

features of patches -> anchors: frames of the result that show the place of the new ones, spread over its path
windows of anchors and new frames, run by the method as it is
each window is joined to the result, and to other windows, by the depth, confidence and cameras of its anchors
all joins are solved together; the old frames stay as they are, bit by bit
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy.spatial.transform import Rotation

from vggtjax.cameras import align, camera_centres, checked_centres
from vggtjax.clips.clip import Clip, read_clip
from vggtjax.clips.fingerprint import source_setting
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, one_line
from vggtjax.method.fusion.family import FusionParams
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.windows.graph import IDENTITY, edge_of, solve_graph
from vggtjax.pipeline.windows.join import Join, JoinRule, join_windows, reach_of
from vggtjax.pipeline.windows.overlap import FEWEST_ANCHORS, LEAST_OVERLAP, Places, choose_anchors
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.pipeline.windows.run import Tools, tools_of
from vggtjax.pipeline.windows.store import FOLDER, WindowStore
from vggtjax.pipeline.windows.whole import window_name
from vggtjax.progress import OnStage, Progress, no_stage
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import versions
from vggtjax.results.result import ARRAYS, TRACKS, missing_fields, show_points, without_mask
from vggtjax.storage.interruption import kept
from vggtjax.storage.writing import locked_folder, write_errors

logger = logging.getLogger(__name__)

DEFAULT = Windows(32, 8)
_LEAST_STATIC = 0.02  # share of a frame's pixels; with less, an anchor says nothing of where it is
_WORST = 0.2  # residual of a join, relative to depth; with more, anchors and new frames do not fit together
_STACKED = tuple(name for name in ARRAYS if name not in {*TRACKS, "timestamps"})
_OF_CLIP = ("images", "source_size", "source_scale", "source_offset", "valid_box")


class _Window(NamedTuple):
    """New frames that are run together with anchors, which come first."""

    frames: range  # the new frames, by number in the new clip
    anchors: list[int]  # by number in the joined result
    joins: dict[int, Join]  # that fit: to the old result (0) and to earlier windows (1, 2, ...)


@dataclasses.dataclass(frozen=True)
class Extending:
    """How a result is extended.

    Attributes:
        prefix: letters before the names of the new frames, for clips whose frames have the names of old ones
        windows: frames of a window, and how many of them are anchors, at least 3
        rule: how anchors join
    """

    prefix: str = ""
    windows: Windows = DEFAULT
    rule: JoinRule = JoinRule()

    def __post_init__(self) -> None:
        if not self.windows.window:
            raise InputError("window is 0 or missing; new frames are run in windows, such as 32 frames with 8 anchors")
        if self.windows.shared < FEWEST_ANCHORS:
            raise InputError(f"overlap is {self.windows.shared}; expected at least {FEWEST_ANCHORS} anchors")


def extend(
    model: Model,
    result: Reconstruction,
    clip: Clip | ClipSource,
    *,
    out: str | Path | None = None,
    extending: Extending = Extending(),
    options: Options | None = None,
    fusion: FusionParams | None = None,
    on_stage: OnStage = no_stage,
) -> Reconstruction:
    """Return a result with the frames of `result`, bit by bit, and behind them those of a clip of the same place.

    The new frames are in the frame and the scale of the old ones; points that were tracked are not followed in them.
    `settings["extended"]` says of each extension where its frames are from, and how well the anchors agree.

    Args:
        model: the one that made the result.
        result: of one clip, of windows, or itself extended.
        clip: the new frames, fitted as those of the result: what `load_clip` returned, or what it takes.
        out: folder in which windows that are done are kept, so that the same call goes on where a killed run stopped;
            they are removed at the end, and the result is not written. None: nothing is kept.
        extending: how the new frames are run and joined.
        options: as for `reconstruct`; by default those of the result.
        fusion: as for `reconstruct`.
        on_stage: as for `reconstruct`.

    Raises:
        InputError: a result of another model or without stored pictures, frames of another size or of equal names, new
            frames that show another place, or anchors on which everything moves or that do not agree.
        ClipError: a source that cannot be read.
        OutputError: `out` cannot be written, or another run is writing it.
        DeviceMemoryError: a window does not fit in the memory of the device.
    """
    options = options or options_of(result)
    check_result(model, result)
    if not isinstance(clip, Clip):
        with on_stage("load clip") as progress:
            clip = read_clip(open_source(clip), Sampling(), fitter_of(result), progress)
    names = [extending.prefix + name for name in clip.frame_names]
    _check_clip(result, clip, names)
    tools = tools_of(model, options.changed(consistent_depth=False), clip.size, fusion=fusion)
    read: Clip = clip

    def agree(window: Reconstruction, part: range, anchored: Clip) -> Reconstruction:
        def pictures() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
            yield from _bytes(anchored.images[: len(anchored) - len(part)])
            yield from islice(read.pictures(), part.start, part.stop)

        return agree_with_pixels(window, pictures, options.changed(refine_cameras=False), on_stage=on_stage)

    settings = {
        "extend": [result.frame_names, names, extending.windows.window, extending.windows.shared],
        "model": model.identity.to_json(),
        "options": options.to_json(),
        "versions": versions(),
    }
    growth = Growth(result, clip, names, extending)
    if out is None:
        return without_mask(grow(growth, tools, extending.windows, agree, None, on_stage))
    with _kept_windows(Path(out), settings) as store:
        return without_mask(grow(growth, tools, extending.windows, agree, store, on_stage))


@contextmanager
def _kept_windows(out: Path, settings: Mapping[str, Any]) -> Iterator[WindowStore]:
    """Yield where windows are kept while they are run: until the end, or until the frames turn out not to fit."""
    is_new = not out.is_dir()
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    with locked_folder(out / FOLDER, "the windows of a clip"):
        store = WindowStore(out, settings)
        try:
            with kept(lambda: f"{store.count()} windows are kept; the same command goes on from there"):
                yield store
        except InputError:
            store.remove()
            if is_new:
                with suppress(OSError):
                    out.rmdir()
            raise
        store.remove()


def options_of(result: Reconstruction) -> Options:
    """Return the options that a result was made with, as far as its settings tell, without `refine_cameras`."""
    names = {field.name for field in dataclasses.fields(Options)} - {"method", "refine_cameras", "mask"}
    try:
        return Options(result.method, **{name: result.settings[name] for name in names & result.settings.keys()})
    except InputError as error:
        raise InputError(f"the settings of the result cannot be taken over: {error}") from error


def check_result(model: Model, result: Reconstruction) -> None:
    """Raise InputError where a result is not of this model, or lacks what anchors need."""
    if result.model_name != model.name:
        raise InputError(
            f"the result is of the model {one_line(result.model_name, 60)!r} and {model.name!r} is given; expected the "
            "model that made the result"
        )
    if missing := {"images", "depth_confidence"} & set(missing_fields(result)):
        raise InputError(
            f"the result has no {' or '.join(sorted(missing))} of its frames; expected a result of vggtjax"
        )
    if (patch := result.settings.get("patch")) != model.config.patch_size:
        raise InputError(f"the result has patches of {patch} pixels; expected {model.config.patch_size}, the model's")


def fitter_of(result: Reconstruction) -> Fitter:
    """Return what fits new frames as those of a result are fitted. Raises InputError where its settings do not tell."""
    try:
        return msgspec.convert({name: result.settings[name] for name in ("mode", "size", "patch")}, Fitter)
    except (KeyError, msgspec.ValidationError) as error:
        raise InputError(f"the settings of the result do not tell how its frames were fitted: {error}") from error


def _check_clip(result: Reconstruction, clip: Clip, names: list[str]) -> None:
    sizes = [(array.shape[2], array.shape[1]) for array in (clip.images, result.images)]
    if sizes[0] != sizes[1]:
        (a, b), (c, d) = sizes
        raise InputError(
            f"the new frames are fitted to {a} x {b} pixels and the result has {c} x {d}; expected frames of the same "
            "shape: crop them, or make the result with --preprocess pad"
        )
    equal = sorted(set(result.frame_names) & set(names))
    if equal:
        more = f" and {len(equal) - 1} more" if len(equal) > 1 else ""
        raise InputError(
            f"the frame {one_line(equal[0], 60)!r}{more} of the new clip has the name of a frame of the result; give "
            "the new ones a prefix, such as --prefix day2_, or leave out frames that the result has"
        )


class Growth:
    """The old result (node 0) and the windows of new frames (nodes 1, 2, ...), while they are run and joined."""

    def __init__(self, result: Reconstruction, clip: Clip, names: list[str], extending: Extending) -> None:
        self.clip, self.names, self.rule = clip, names, extending.rule
        self.nodes: list[Reconstruction] = [result]
        self.windows: list[_Window] = []
        self.frames = [(0, frame) for frame in range(len(result.depth))]  # node, and number in it
        self.usable = _shows_static(result)
        self.centres = camera_centres(result.camera_from_world).astype(np.float64)
        self.worlds = [IDENTITY]  # along the best join; all are solved together at the end

    def anchored(self, part: range, anchors: list[int]) -> Clip:
        """Return anchors and new frames as a clip; anchors have the pictures that their results store."""
        placed = [(self.nodes[node], number) for node, number in map(self.frames.__getitem__, anchors)]
        count, new, size = len(placed), slice(part.start, part.stop), self.clip.images.shape[1:3]

        def joined(name: str, of_anchors: list[Any]) -> np.ndarray:
            return np.concatenate([np.stack(of_anchors), getattr(self.clip, name)[new]])

        return dataclasses.replace(
            self.clip,
            images=joined("images", [result.images[number] / np.float32(255) for result, number in placed]),
            frame_names=[result.frame_names[number] for result, number in placed] + self.names[new],
            timestamps=None,
            source_size=joined("source_size", [size] * count),
            source_scale=joined("source_scale", [(1.0, 1.0)] * count),
            source_offset=joined("source_offset", [(0.0, 0.0)] * count),
            valid_box=joined("valid_box", [result.valid_box[number] for result, number in placed]),
        )

    def add(self, part: range, anchors: list[int], window: Reconstruction) -> None:
        """Join a window by its anchors. Raises InputError where none of its joins fits."""
        number, pairs = len(self.nodes), {}
        for position, (node, frame) in enumerate(map(self.frames.__getitem__, anchors)):
            pairs.setdefault(node, []).append((frame, position))
        joins = {node: join_windows(self.nodes[node], window, found, self.rule) for node, found in pairs.items()}
        fits = {node: join for node, join in joins.items() if join.pixels and join.residual <= _WORST}
        if not fits:
            best = min(join.residual for join in joins.values())
            raise InputError(
                f"the new frames {self.names[part.start]} to {self.names[part.stop - 1]} cannot be joined: depth and "
                f"cameras of the anchors differ by {best:.0%} of the depth, more than {_WORST:.0%}, or show nothing "
                "that stands still; expected frames that see the place of the result"
            )
        best = min(fits, key=lambda node: fits[node].residual)
        self.worlds.append(self.worlds[best].after(fits[best].similarity))
        self.windows.append(_Window(part, anchors, fits))
        self.nodes.append(window)
        new = range(len(anchors), len(window.depth))
        self.frames += [(number, frame) for frame in new]
        self.usable = np.concatenate([self.usable, _shows_static(window)[new.start :]])
        poses = align(window.camera_from_world[new.start :], self.worlds[-1])
        self.centres = np.concatenate([self.centres, checked_centres(poses)])

    def solve(self) -> None:
        """Solve all joins together; the old result stays."""
        found = [
            (join.residual, node, number) for number, w in enumerate(self.windows, 1) for node, join in w.joins.items()
        ]
        usual = float(np.median([residual for residual, *_ in found]))
        edges = [
            edge_of(node, number, self.windows[number - 1].joins[node].similarity, residual, usual)
            for residual, node, number in found
        ]
        self.worlds = solve_graph(len(self.nodes), edges, [reach_of(node) for node in self.nodes])

    def result(self) -> Reconstruction:
        """Return the joined result."""
        old = self.nodes[0]
        fields = {name: self._stacked(name) for name in _STACKED}
        fields |= {name: self._untracked(name) for name in TRACKS - {"track_frames"} if old.track_frames is not None}
        facts = {"clip": self.clip.source.name, "first": len(old.depth), "frames": len(self.clip)}
        facts |= source_setting(self.clip.source) | {
            "windows": [self._facts(number) for number in range(len(self.windows))]
        }
        extended = old.settings.get("extended")
        earlier = extended if isinstance(extended, list) else []
        return dataclasses.replace(
            old,
            **fields,
            frame_names=(*old.frame_names, *self.names),
            timestamps=_times(old, self.clip),
            settings=old.settings | {"extended": [*earlier, facts]},
            passes=None,
        )

    def _stacked(self, name: str) -> np.ndarray | None:
        """Return a field of the old frames, and of the new ones in the world of the old."""
        old = getattr(self.nodes[0], name)
        if old is None:
            return None
        if name in _OF_CLIP:
            new = [getattr(self.clip, name)]
            new = [np.round(255 * new[0]).astype(np.uint8)] if name == "images" else new
        else:
            new = []
            for window, node, world in zip(self.windows, self.nodes[1:], self.worlds[1:], strict=True):
                value = getattr(node, name)
                if value is None:  # matches that could not be used: all patches are as the median
                    value = np.ones((len(node.depth), *old.shape[1:]), old.dtype)
                value = value[len(window.anchors) :]
                value = world.scale * value if name == "depth" else value
                new.append(align(value, world) if name == "camera_from_world" else value)
        return np.concatenate([old, *(np.asarray(part, old.dtype) for part in new)])

    def _untracked(self, name: str) -> np.ndarray:
        old = getattr(self.nodes[0], name)
        return np.concatenate([old, np.zeros((len(self.clip), *old.shape[1:]), old.dtype)])

    def _facts(self, number: int) -> dict[str, Any]:
        """Return how well the anchors of a window agree, as JSON values."""
        window, node, world = self.windows[number], self.nodes[number + 1], self.worlds[number + 1]
        placed = [self.frames[frame] for frame in window.anchors]
        before = np.concatenate([align(self.nodes[n].camera_from_world[f][None], self.worlds[n]) for n, f in placed])
        after = align(node.camera_from_world[: len(placed)], world)
        turned = Rotation.from_matrix(after[:, :, :3] @ before[:, :, :3].swapaxes(1, 2)).magnitude()
        moved = np.linalg.norm(checked_centres(after) - checked_centres(before), axis=1) / reach_of(self.nodes[0])
        return {
            "frames": [window.frames.start, window.frames.stop],
            "anchors": [self.nodes[n].frame_names[f] for n, f in placed],
            "degrees": round(float(np.degrees(np.median(turned))), 3),
            "distance": round(float(np.median(moved)), 4),  # relative to the median depth of the result
            "residuals": {str(n): round(join.residual, 5) for n, join in window.joins.items()},
        }


def grow(
    growth: Growth,
    tools: Tools,
    windows: Windows,
    agree: Callable[[Reconstruction, range, Clip], Reconstruction],
    store: WindowStore | None = None,
    on_stage: OnStage = no_stage,
) -> Reconstruction:
    """Choose anchors, run the windows, join them, and return the joined result."""
    clip, old = growth.clip, growth.nodes[0]
    assert windows.window is not None
    with on_stage("compare frames") as progress:
        known, columns = _patches(tools, old.images, progress)
        fresh, _ = _patches(tools, clip.images, progress)
    places = Places.of(known, columns)
    length = windows.window - windows.shared
    parts = [range(start, min(start + length, len(clip))) for start in range(0, len(clip), length)]
    with on_stage("windows") as progress:
        for number, part in enumerate(parts, start=1):
            overlaps = places.overlaps(fresh[part.start : part.stop])
            anchors = choose_anchors(overlaps, growth.centres, growth.usable, windows.shared)
            if not anchors:
                raise InputError(_without_anchor(growth, part, overlaps))
            anchored, name = growth.anchored(part, anchors), window_name(number)
            window = None if store is None else store.find(name, anchored.frame_names, _bytes(anchored.images))
            if window is None:
                window = agree(tools.run(anchored), part, anchored)
                if store is not None:
                    store.save(name, window)
            growth.add(part, anchors, window)
            places = places.joined(fresh[part.start : part.stop])
            if progress is not None:
                progress(number, len(parts))
    growth.solve()
    return growth.result()


def _patches(tools: Tools, images: np.ndarray, progress: Progress | None) -> tuple[Float32[np.ndarray, "F N C"], int]:
    """Return the patches of frames, one frame at a time, and how many are in a row."""
    assert tools.patches is not None
    found, columns = [], 1
    for number, image in enumerate(images, start=1):
        pixels = image / np.float32(255) if image.dtype == np.uint8 else image
        patches, columns = tools.patches(pixels[None])
        found.append(patches[0])
        if progress is not None:
            progress(number, len(images))
    return np.stack(found), columns


def _without_anchor(growth: Growth, part: range, overlaps: Float64[np.ndarray, "M F"]) -> str:
    named = f"the new frames {growth.names[part.start]} to {growth.names[part.stop - 1]}"
    if (best := overlaps.max()) >= LEAST_OVERLAP:
        return f"{named} overlap only with frames on which everything moves; expected anchors with something at rest"
    return (
        f"{named} show another place: they overlap with the known frames by at most {max(best, 0):.2f}, and frames of "
        f"one place overlap by at least {LEAST_OVERLAP}; reconstruct them on their own, or add frames in between"
    )


def _shows_static(result: Reconstruction) -> Bool[np.ndarray, " S"]:
    """Return the frames of which enough is known and stands still."""
    shares = [
        (show_points(depth, confidence, inside) & ~moving).mean()
        for depth, confidence, inside, moving in zip(
            result.depth, result.depth_confidence, result.inside_pictures, result.dynamic_mask, strict=True
        )
    ]
    return np.array(shares) >= _LEAST_STATIC


def _times(result: Reconstruction, clip: Clip) -> Float64[np.ndarray, " S"] | None:
    """Return the times of all frames where both have those of one clock, and the new ones are later; else None."""
    times = getattr(clip.source, "times", None)
    first = result.settings.get("first_time")
    if result.timestamps is None or clip.timestamps is None or times is None or not isinstance(first, float | int):
        return None
    new = clip.timestamps + (float(times.first) - first)
    return np.concatenate([result.timestamps, new]) if new[0] > result.timestamps[-1] else None


def _bytes(images: Float32[np.ndarray, "F H W 3"]) -> UInt8[np.ndarray, "F H W 3"]:
    return np.round(255 * images).astype(np.uint8)
