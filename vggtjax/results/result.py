"""The fields of a reconstructed clip, their checks, and derived values."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from vggtjax.cameras import FIELD_OF_VIEW_RANGE, camera_centres, clamp_intrinsics, unproject, world_from_camera
from vggtjax.errors import ResultError
from vggtjax.options import METHODS
from vggtjax.results.instances import find_instances
from vggtjax.results.visible import inside_box, show_points
from vggtjax.storage.arrays import is_mapped, zeros_beside

_TIME = re.compile(r"\d{1,18}\.\d{1,18}")  # in seconds, as a frame's name
_EXACT, _FEWEST_DIGITS = re.compile(r"-?\d{1,20}(?:\.\d{1,20})?"), 6  # seconds; digits after the point
_MOST_SIDE, _MOST_PIXELS = 1 << 20, 1 << 28  # of a source's picture


class FieldOfViewWarning(UserWarning):
    """Cameras whose field of view was clamped because no pinhole camera has it."""


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Cameras, depth and motion of a clip of S frames, at the model's size of H x W pixels in h x w patches.

    A pixel whose depth is 0, negative or not finite, or whose confidence is not finite, has unknown depth and becomes
    no point. Arrays of a wider type are cast to the type below, `dynamic_mask` is cleared in padding, and fields of
    view outside [0.01, 3.1] rad are clamped with a FieldOfViewWarning that names the frames.

    Raises ResultError if the fields do not fit together, or if all depths or all confidences of a frame are NaN or
    infinite, which broken weights cause. A frame of unknown depth has depth 0. Of a long result, as `reconstruct_long`
    gives it, the large arrays are mapped files, whose values are read when they are used and not checked.
    """

    depth: Float32[np.ndarray, "S H W"]  # z in the camera, up to scale
    depth_confidence: Float32[np.ndarray, "S H W"]  # above 0; higher is more certain; compare by rank, not by value
    saliency: Float32[np.ndarray, "S h w"] | None  # motion of each patch, in [0, 1], where known
    dynamic_mask: Bool[np.ndarray, "S H W"]
    camera_from_world: Float32[np.ndarray, "S 3 4"]  # OpenCV axes: x right, y down, z forward
    intrinsics: Float32[np.ndarray, "S 3 3"]  # pixels of H x W
    images: UInt8[np.ndarray, "S H W 3"]
    frame_names: tuple[str, ...]
    timestamps: Float64[np.ndarray, " S"] | None  # seconds, where known
    method: str
    model_name: str
    settings: dict[str, Any]  # JSON values
    source_size: Int64[np.ndarray, "S 2"]  # height, width of the source pictures
    source_scale: Float64[np.ndarray, "S 2"]  # source (x, y) = scale * (x, y) + offset; pixel edges at integers
    source_offset: Float64[np.ndarray, "S 2"]
    valid_box: Int64[np.ndarray, "S 4"]  # left, top, right, bottom; pixels outside are padding
    track_positions: Float32[np.ndarray, "S Q 2"] | None = None  # x, y in pixels of H x W
    track_visibility: Float32[np.ndarray, "S Q"] | None = None  # probabilities
    track_confidence: Float32[np.ndarray, "S Q"] | None = None
    track_frames: Int64[np.ndarray, " Q"] | None = None  # of the queries
    motion: Float32[np.ndarray, "S h w"] | None = None  # of each patch, by matches or pixels, over the median
    passes: Any = None  # outputs of the network; in memory only, never saved

    def __post_init__(self) -> None:
        for name, (dtype, _) in ARRAYS.items():
            if name not in OPTIONAL or getattr(self, name) is not None:
                self._set(name, _cast(name, getattr(self, name), dtype))
        self._set("frame_names", tuple(self.frame_names))
        self._set("settings", _json_values(self.settings))
        shapes = {name: getattr(self, name).shape for name in ARRAYS if getattr(self, name) is not None}
        check_shapes(shapes | {"frame_names": (len(self.frame_names),)})
        intrinsics, clamped = clamp_intrinsics(self.intrinsics, *self.depth.shape[1:])
        self._set("intrinsics", intrinsics)
        self._check_cameras()
        self._check_places()
        if not is_mapped(self.depth):  # reading all of a mapped file would take as long as computing with it
            padding = ~self.inside_pictures
            self._check_depth(padding)
            if (self.dynamic_mask & padding).any():
                self._set("dynamic_mask", self.dynamic_mask & ~padding)
        if clamped:
            listed = ", ".join(map(str, clamped[:10])) + (f" and {len(clamped) - 10} more" if len(clamped) > 10 else "")
            warnings.warn(
                f"the field of view of frames {listed} was clamped to {list(FIELD_OF_VIEW_RANGE)} rad; "
                "their cameras and points are not to be trusted",
                FieldOfViewWarning,
                stacklevel=3,
            )

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_cameras(self) -> None:
        rotation = self.camera_from_world[:, :, :3]
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
            rigid = (error < 0.01) & (np.linalg.det(rotation) > 0)
        rigid &= np.isfinite(self.camera_from_world).all(axis=(1, 2))
        if not rigid.all():
            raise ResultError(f"camera_from_world of frame {np.argmin(rigid)} is not a finite rotation and translation")
        for name in ("intrinsics", "timestamps", "source_scale", "source_offset", *sorted(TRACKS)):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ResultError(f"{name} holds {value[~np.isfinite(value)][0]}; expected finite numbers")

    def _check_places(self) -> None:
        """Check the sizes of the sources, the frames of the tracks and the boxes inside the padding."""
        sides = self.source_size
        outside = (sides < 1).any() or (sides > _MOST_SIDE).any() or (sides.prod(axis=1) > _MOST_PIXELS).any()
        if outside or (self.source_scale <= 0).any():
            raise ResultError(
                f"source_size or source_scale is out of range; expected sides of 1 to {_MOST_SIDE}, at most "
                f"{_MOST_PIXELS} pixels, and scales above 0"
            )
        frames, last = self.track_frames, len(self.depth) - 1
        if frames is not None and ((frames < 0) | (frames > last)).any():
            raise ResultError(f"track_frames holds {frames[(frames < 0) | (frames > last)][0]}; expected 0 to {last}")
        height, width = self.depth.shape[1:]
        left, top, right, bottom = self.valid_box.T
        inside = (left >= 0) & (left < right) & (right <= width) & (top >= 0) & (top < bottom) & (bottom <= height)
        if not inside.all():
            frame = int(np.argmin(inside))
            raise ResultError(
                f"valid_box of frame {frame} is {self.valid_box[frame].tolist()}; expected left < right and "
                f"top < bottom inside {width} x {height} pixels"
            )

    def _check_depth(self, padding: Bool[np.ndarray, "S H W"]) -> None:
        for name in ("depth", "depth_confidence"):
            lost = ~np.isfinite(getattr(self, name))
            without = (lost | padding).all(axis=(1, 2))
            if without.any():
                raise ResultError(
                    f"{name} of frame {np.argmax(without)} has no finite value, and {lost.sum()} of {lost.size} values "
                    "of the clip are not finite; check the weights and the inputs (unknown depth is written as 0)"
                )

    def __repr__(self) -> str:
        frames, height, width = self.depth.shape
        return (
            f"{type(self).__name__}({frames} frames of {width} x {height} pixels, method {self.method!r}, "
            f"model {self.model_name!r}, {f'{self.dynamic_share:.1%} dynamic' if self.has_mask else 'no mask'})"
        )

    @property
    def inside_pictures(self) -> Bool[np.ndarray, "S H W"]:
        """Pixels that are not padding."""
        return inside_box(self.valid_box, self.depth.shape[1:])

    @property
    def valid_pixels(self) -> Bool[np.ndarray, "S H W"]:
        """Pixels that show a point: not padding, with a finite depth above 0 and a finite confidence."""
        return self._mapped_valid if is_mapped(self.depth) else self._valid(slice(None))

    @cached_property
    def _mapped_valid(self) -> Bool[np.ndarray, "S H W"]:
        valid = zeros_beside(self.depth, bool)
        for frame in range(len(valid)):
            valid[frame] = self._valid(frame)
        return valid

    def _valid(self, frames: int | slice) -> Bool[np.ndarray, "*F H W"]:
        inside = inside_box(self.valid_box[frames], self.depth.shape[1:])
        return show_points(self.depth[frames], self.depth_confidence[frames], inside)

    @property
    def has_mask(self) -> bool:
        """Whether `dynamic_mask` tells what moves; the method vggt makes no mask, nor do some other programs."""
        return "dynamic_mask" not in missing_fields(self)

    @property
    def dynamic_share(self) -> float:
        """Share of the pixels that are dynamic, of those that are not padding."""
        return float(self.dynamic_mask.sum() / self.pictured)

    @property
    def pictured(self) -> int:
        """Number of pixels that are not padding."""
        left, top, right, bottom = self.valid_box.T
        return int(((right - left) * (bottom - top)).sum())

    @cached_property
    def instances(self) -> UInt8[np.ndarray, "S H W"]:
        """Moving objects: 0 where nothing moves, else the same id in all frames; see `find_instances`."""
        return find_instances(self.dynamic_mask, map(self._points_of_motion, range(len(self.depth))))

    def _points_of_motion(self, frame: int) -> Float32[np.ndarray, "H W 3"]:
        """Return the points of the world that a frame shows, NaN where the depth is unknown."""
        depth = np.where(self._valid(frame), self.depth[frame], np.nan).astype(np.float32)
        return unproject(depth, self.intrinsics[frame], self.camera_from_world[frame], pixel_offset=0.5)

    @property
    def camera_centres(self) -> Float32[np.ndarray, "S 3"]:
        """Centres of the cameras in the world."""
        return camera_centres(self.camera_from_world)

    @property
    def world_from_camera(self) -> Float32[np.ndarray, "S 4 4"]:
        """Poses of the cameras in the world, as 4x4 matrices."""
        return world_from_camera(self.camera_from_world)

    @property
    def file_times(self) -> Float64[np.ndarray, " S"]:
        """Times of the frames by the source's own clock, for files that others pair with theirs.

        They are those of a capture, those in the frames' names (1305031102.175304), or seconds from a video's first
        frame; frames without times are numbered from 0.
        """
        first = self.settings.get("first_time")
        if self.timestamps is not None and isinstance(first, float | int) and np.isfinite(first):
            return self.timestamps + first
        if all(_TIME.fullmatch(name) for name in self.frame_names):
            return np.array([float(name) for name in self.frame_names])
        return np.arange(len(self.depth), dtype=np.float64) if self.timestamps is None else self.timestamps

    @property
    def file_time_texts(self) -> tuple[str, ...]:
        """`file_times` as texts with all digits of the source: nanoseconds since 1970 do not fit 64 bits."""
        exact, digits = self.settings.get("first_time_exact"), self.settings.get("time_digits")
        if self.timestamps is None or not isinstance(exact, str) or not _EXACT.fullmatch(exact):
            return tuple(f"{time:.6f}" for time in self.file_times)
        digits = digits if isinstance(digits, int) and digits in range(_FEWEST_DIGITS, 10) else _FEWEST_DIGITS
        return tuple(f"{Decimal(exact) + Decimal(float(time)):.{digits}f}" for time in self.timestamps)

    @property
    def model_note(self) -> str:
        """A caution about the model for readers of the files, on one line; empty for most models."""
        return " ".join(str(self.settings.get("model_note", "")).split()).encode(errors="replace").decode()

    @property
    def known_facts(self) -> dict[str, str]:
        """How cameras and depth were refined and brought to known ones and to lengths, and where times are from."""
        found = self._known.get("found")
        done = {"cameras": self.settings.get("refined_cameras"), "depth": self.settings.get("consistency")}
        facts = {name: outcome.get("sentence") for name, outcome in done.items() if isinstance(outcome, dict)}
        facts |= {"times": f"from {self.settings['times']}"} if "times" in self.settings else {}
        facts |= found if isinstance(found, dict) else {}
        return {name: text for name, text in facts.items() if isinstance(text, str)}

    @property
    def length_unit(self) -> str:
        """The unit of depth and cameras: "metre", or "unit of the poses" (given ones), "... capture", "... model"."""
        unit = self._known.get("lengths")
        return unit if unit in ("metre", "unit of the poses", "unit of the capture") else "unit of the model"

    @property
    def _known(self) -> dict[str, Any]:
        known = self.settings.get("known")
        return known if isinstance(known, dict) else {}

    def world_points(self, *, pixel_offset: float = 0.5) -> Float32[np.ndarray, "S H W 3"]:
        """Lift every pixel to its point in the world, padding and unsure pixels too.

        `pixel_offset` 0.5 takes pixel centres, as for a principal point at (W/2, H/2); the refinement of masks does the
        same. VGGT's own unprojection uses 0.0: its points lie half a pixel up and left of these.
        """
        return unproject(self.depth, self.intrinsics, self.camera_from_world, pixel_offset=pixel_offset)


def _arrays() -> dict[str, tuple[np.dtype, tuple[str | int, ...]]]:
    """Return name -> type and dimensions of the fields of `Result` annotated as arrays."""
    hints = {name: (get_args(hint) or (hint,))[0] for name, hint in get_type_hints(Result).items()}
    return {
        name: (np.dtype(hint.dtypes[0]), tuple(int(side) if side.isdigit() else side for side in hint.dim_str.split()))
        for name, hint in hints.items()
        if hasattr(hint, "dim_str")
    }


AnyResult = TypeVar("AnyResult", bound=Result)  # also a Reconstruction: what is given comes back in its own class
ARRAYS = _arrays()  # S, H, W are those of depth, h, w of saliency, Q of track_frames; all others must match
TRACKS = frozenset(name for name in ARRAYS if name.startswith("track_"))  # all are given, or none
OPTIONAL = TRACKS | {"timestamps", "saliency", "motion"}
STRINGS: dict[str, tuple[str | int, ...]] = {"frame_names": ("S",), "method": (), "model_name": (), "settings": ()}


def missing_fields(result: Result) -> tuple[str, ...]:
    """Return the fields that a method or another program does not make, and for which plain values stand."""
    missing = result.settings.get("missing")
    named = tuple(name for name in missing if isinstance(name, str)) if isinstance(missing, list) else ()
    return (*named, "dynamic_mask") if makes_no_mask(result) and "dynamic_mask" not in named else named


def makes_no_mask(result: Result) -> bool:
    """Return whether a method of ours made the result and makes no mask, and none was given."""
    return _masks_are_ours(result) and result.method in METHODS and not METHODS[result.method].needs_second_pass


def mask_is_mined(result: Result) -> bool:
    """Return whether a method of ours mined the mask of the result, in some of its windows at least."""
    return _masks_are_ours(result) and "mined" in str(result.settings.get("masks")) and not makes_no_mask(result)


def _masks_are_ours(result: Result) -> bool:
    return str(result.settings.get("masks")).startswith(("mined", "none"))


def without_mask(result: AnyResult) -> AnyResult:
    """Return the result of a method that makes no mask without mask, saliency and motion; others as they are."""
    if not makes_no_mask(result):
        return result
    settings = result.settings | {"masks": f"none: {result.method} makes no mask"}
    nothing = np.zeros(result.dynamic_mask.shape, bool)
    return replace(result, dynamic_mask=nothing, saliency=None, motion=None, settings=settings)


def check_shapes(shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ResultError unless every shape is as the tables say."""
    for name in ("depth", "saliency"):
        if name in shapes and (len(shapes[name]) != 3 or 0 in shapes[name]):
            raise ResultError(f"{name} has shape {shapes[name]}; expected (frames, rows, columns), none of them 0")
    sizes: dict[str | int, int] = dict(zip("SHW", shapes["depth"], strict=True))
    if "saliency" in shapes:
        sizes |= dict(zip("hw", shapes["saliency"][1:], strict=True))
    if tracks := TRACKS & set(shapes):
        if missing := sorted(TRACKS - tracks):
            raise ResultError(f"tracks lack {', '.join(missing)}")
        if len(shapes["track_frames"]) != 1:
            raise ResultError(f"track_frames has shape {shapes['track_frames']}; expected one number per track")
        sizes["Q"] = shapes["track_frames"][0]
    for name, shape in shapes.items():
        dimensions = ARRAYS[name][1] if name in ARRAYS else STRINGS[name]
        expected = tuple(sizes.get(dimension, dimension) for dimension in dimensions)
        if shape != expected:
            raise ResultError(f"{name} has shape {shape}; expected {expected} to go with depth {shapes['depth']}")
    if "saliency" in shapes and (sizes["H"] % sizes["h"] or sizes["W"] % sizes["w"]):
        raise ResultError(
            f"saliency has {sizes['h']} x {sizes['w']} patches, which do not divide {sizes['H']} x {sizes['W']} pixels"
        )


def _cast(name: str, value: Any, dtype: np.dtype) -> np.ndarray:
    array = value if is_mapped(value) else np.asarray(value)
    if not np.can_cast(array.dtype, dtype, "same_kind"):
        raise ResultError(f"{name} has type {array.dtype}; expected {dtype}")
    array = array.astype(dtype, copy=False)
    return array if array.flags.writeable or is_mapped(array) else array.copy()  # arrays of jax cannot be written


def _json_values(settings: Any) -> dict[str, Any]:
    try:
        values = json.loads(json.dumps(settings, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ResultError(f"settings cannot be written as JSON: {error}") from None
    if not isinstance(values, dict):
        raise ResultError(f"settings is a {type(settings).__name__}; expected a dictionary")
    return values
