"""The result of a clip: cameras, depth, dynamic masks, and everything needed to use them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from vggtjax import cameras as geometry
from vggtjax.errors import ResultError
from vggtjax.progress import Progress
from vggtjax.results.saving import Saving, SavingChanges
from vggtjax.storage import arrays as archive

if TYPE_CHECKING:
    from vggtjax.storage.trajectories import Quaternion

ARCHIVE_NAME = "reconstruction.npz"
OPTIONAL_FILES = ("tracks.npz", "vggt4d")
_DEFAULT = Saving()
_FORMAT_VERSION = 1
_MOST_FILES = 100
_MOST_PIXELS = 2**28  # of a source's picture

# Arrays: type and dimensions. depth binds S, H, W, saliency h, w and track_frames Q; the others must agree.
_ARRAYS: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "depth": (np.float32, ("S", "H", "W")),
    "depth_confidence": (np.float32, ("S", "H", "W")),
    "saliency": (np.float32, ("S", "h", "w")),
    "dynamic_mask": (np.bool_, ("S", "H", "W")),
    "camera_from_world": (np.float32, ("S", 3, 4)),
    "intrinsics": (np.float32, ("S", 3, 3)),
    "images": (np.uint8, ("S", "H", "W", 3)),
    "source_size": (np.int64, ("S", 2)),
    "source_scale": (np.float64, ("S", 2)),
    "source_offset": (np.float64, ("S", 2)),
    "valid_box": (np.int64, ("S", 4)),
    "timestamps": (np.float64, ("S",)),
    "track_positions": (np.float32, ("S", "Q", 2)),
    "track_visibility": (np.float32, ("S", "Q")),
    "track_confidence": (np.float32, ("S", "Q")),
    "track_frames": (np.int64, ("Q",)),
}
_TRACKS = frozenset(name for name in _ARRAYS if name.startswith("track_"))  # all there, or none
_OPTIONAL = _TRACKS | {"timestamps", "saliency"}
_STRINGS: dict[str, tuple[str | int, ...]] = {"frame_names": ("S",), "method": (), "model_name": (), "settings": ()}


class FieldOfViewWarning(UserWarning):
    """Cameras whose field of view was clamped because no pinhole camera has it."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Cameras, depth and motion of a clip of S frames, at the model's size of H x W pixels in h x w patches.

    Arrays of a wider type are cast to the one named. Fields of view outside [0.01, 3.1] rad are clamped with a
    FieldOfViewWarning that names the frames. Raises ResultError where the fields do not fit together.
    """

    depth: Float32[np.ndarray, "S H W"]  # z in the camera, up to scale
    depth_confidence: Float32[np.ndarray, "S H W"]  # above 0; higher is surer; compare by rank, not by value
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
    track_frames: Int64[np.ndarray, " Q"] | None = None  # in which each point was asked for
    passes: Any = None  # what the network computed on the way; in memory only, never saved

    def __post_init__(self) -> None:
        for name, (dtype, _) in _ARRAYS.items():
            if name not in _OPTIONAL or getattr(self, name) is not None:
                object.__setattr__(self, name, _cast(name, getattr(self, name), dtype))
        object.__setattr__(self, "frame_names", tuple(self.frame_names))
        object.__setattr__(self, "settings", _json_values(self.settings))
        shapes = {name: getattr(self, name).shape for name in _ARRAYS if getattr(self, name) is not None}
        _check_shapes(shapes | {"frame_names": (len(self.frame_names),)})
        intrinsics, clamped = geometry.clamp_intrinsics(self.intrinsics, *self.depth.shape[1:])
        object.__setattr__(self, "intrinsics", intrinsics)
        self._check_values()
        if clamped:
            lowest, highest = geometry.FIELD_OF_VIEW_RANGE
            warnings.warn(
                f"the field of view of frames {_listed(clamped)} was clamped to [{lowest}, {highest}] rad; "
                "their cameras and points are not to be trusted",
                FieldOfViewWarning,
                stacklevel=3,
            )

    def _check_values(self) -> None:
        height, width = self.depth.shape[1:]
        rotation = self.camera_from_world[:, :, :3]
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
            rigid = (error < 0.01) & (np.linalg.det(rotation) > 0)
        rigid &= np.isfinite(self.camera_from_world).all(axis=(1, 2))
        if not rigid.all():
            raise ResultError(f"camera_from_world of frame {np.argmin(rigid)} is not a finite rotation and translation")
        for name in ("intrinsics", "timestamps", "source_scale", "source_offset", *sorted(_TRACKS)):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ResultError(f"{name} holds {value[~np.isfinite(value)][0]}; expected finite numbers")
        sides, most = self.source_size, 1 << 20
        outside = (sides < 1).any() or (sides > most).any() or (sides.prod(axis=1) > _MOST_PIXELS).any()
        if outside or (self.source_scale <= 0).any():
            raise ResultError(
                f"source_size or source_scale is out of range; expected sides of 1 to {most}, at most {_MOST_PIXELS} "
                "pixels, and scales above 0"
            )
        frames, last = self.track_frames, len(self.depth) - 1
        if frames is not None and ((frames < 0) | (frames > last)).any():
            raise ResultError(f"track_frames holds {frames[(frames < 0) | (frames > last)][0]}; expected 0 to {last}")
        left, top, right, bottom = self.valid_box.T
        inside = (left >= 0) & (left < right) & (right <= width) & (top >= 0) & (top < bottom) & (bottom <= height)
        if not inside.all():
            frame = int(np.argmin(inside))
            raise ResultError(
                f"valid_box of frame {frame} is {self.valid_box[frame].tolist()}; expected left < right and "
                f"top < bottom inside {width} x {height} pixels"
            )

    @cached_property
    def instances(self) -> UInt8[np.ndarray, "S H W"]:
        """Moving objects apart: 0 where nothing moves, else the same id in all frames; see `find_instances`."""
        from vggtjax.method.instances import find_instances

        return find_instances(self.dynamic_mask)

    @property
    def camera_centres(self) -> Float32[np.ndarray, "S 3"]:
        """Centres of the cameras in the world."""
        return geometry.camera_centres(self.camera_from_world)

    @property
    def world_from_camera(self) -> Float32[np.ndarray, "S 4 4"]:
        """Poses of the cameras in the world, as 4x4 matrices."""
        return geometry.world_from_camera(self.camera_from_world)

    def world_points(self, *, pixel_offset: float = 0.5) -> Float32[np.ndarray, "S H W 3"]:
        """Lift every pixel to its point in the world, padding and unsure pixels too.

        `pixel_offset` 0.5 sees each pixel at its centre, which fits principal points at (W/2, H/2) and what refining
        the masks does; VGGT's own unprojection uses 0.0, so its points lie half a pixel up and left of these.
        """
        return geometry.unproject(self.depth, self.intrinsics, self.camera_from_world, pixel_offset=pixel_offset)

    def save(
        self,
        folder: str | Path,
        *,
        saving: Saving = _DEFAULT,
        pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None = None,
        progress: Progress | None = None,
        **changes: Unpack[SavingChanges],
    ) -> None:
        """Write the result into `folder`, made if missing; see vggtjax.results.export for the files.

        An earlier result in the folder is replaced as a whole, or left untouched if anything fails; other files stay.

        Args:
            folder: may be missing.
            saving: what to leave out of the point clouds, the size of the files, the format.
            pictures: for the resolution "original", the source's (`Clip.pictures()`); by default the model's enlarged.
            progress: called with the number of files and frames written, and of all.
            changes: single values of `saving`, such as `resolution="original"`; `layout` is the old name of `format`.

        Raises:
            InputError: a percentile outside [0, 100), an unknown name, or pictures that do not fit.
            OutputError: the folder cannot be written, or holds files of the same names that are no earlier result.
        """
        from vggtjax.results import export

        export.save(self, folder, saving.changed(**changes), pictures=pictures, progress=progress)

    def save_archive(self, path: Path, *, files: Sequence[str] = ()) -> None:
        """Write everything but `passes` to one compressed .npz file, which `load` reads back.

        `files` are names beside it that are part of this result, though not of every one.
        """
        arrays = {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}
        strings = {name: getattr(self, name) for name in _STRINGS} | {"settings": json.dumps(self.settings)}
        arrays |= {name: np.array(value, np.str_) for name, value in strings.items()}
        arrays |= {"format_version": np.array(_FORMAT_VERSION), "files": np.array(files, np.str_)}
        archive.write_arrays(path, arrays)

    @classmethod
    def load(cls, path: str | Path, *, layout: str = "vggtjax", quaternion: Quaternion | None = None) -> Reconstruction:
        """Read a result back from its folder, or from its reconstruction.npz; or the folder of another project.

        Args:
            path: the folder or file.
            layout: "vggtjax", or "vggt4d", "monst3r", "cut3r", "da3"; vggtjax.results.foreign says what they are.
                What such a folder lacks is replaced by plain values (confidence 1, nothing moves, grey pictures), with
                a warning logged and named in `settings["missing"]`; the saliency is None.
            quaternion: for "vggt4d" and "monst3r", the order of the quaternions in pred_traj.txt: "wxyz" as these
                projects write it, "xyzw" as TUM and this library do.

        Raises:
            ResultError: anything but a whole result, of a known version.
            InputError: an unknown layout, or a quaternion order that is missing or unknown.
        """
        path = Path(path)
        if layout != "vggtjax":
            from vggtjax.results.foreign import load_foreign

            return load_foreign(path, layout, quaternion)
        file = path / ARCHIVE_NAME if path.is_dir() else path
        if not file.is_file():
            raise ResultError(f"there is no {file}; give the folder of a saved result or its {ARCHIVE_NAME}")
        try:
            _check_headers(archive.read_headers(file))
            fields: dict[str, Any] = {"timestamps": None, "saliency": None, **archive.read_arrays(file)}
            version = int(fields.pop("format_version"))
            fields.pop("files", None)
            if version != _FORMAT_VERSION:
                raise ResultError(f"it has format version {version}; expected {_FORMAT_VERSION}")
            for name in ("method", "model_name", "settings"):
                fields[name] = fields[name].item()
            fields["frame_names"] = tuple(fields["frame_names"].tolist())
            fields["settings"] = json.loads(fields["settings"])
            return cls(**fields)
        except (ResultError, ValueError, RecursionError) as error:  # ValueError: not JSON
            raise ResultError(f"{file} cannot be loaded as a result: {error}") from error


def is_result(path: Path) -> bool:
    """Tell whether `path` looks like a reconstruction.npz of this library, of any version."""
    try:
        return {"format_version", "depth", "camera_from_world"} <= set(archive.read_headers(path))
    except ResultError:
        return False


def saved_files(path: Path) -> tuple[str, ...]:
    """Return the names beside a reconstruction.npz that its result says are part of it, though not of every one."""
    try:
        header = archive.read_headers(path).get("files")
        if header is None or len(header.shape) != 1 or header.shape[0] > _MOST_FILES or header.dtype.kind != "U":
            return ()
        return tuple(name for name in archive.read_arrays(path, ["files"])["files"].tolist() if name in OPTIONAL_FILES)
    except ResultError:
        return ()


def _cast(name: str, value: Any, dtype: type) -> np.ndarray:
    array = np.asarray(value)
    if not np.can_cast(array.dtype, dtype, "same_kind"):
        raise ResultError(f"{name} has type {array.dtype}; expected {np.dtype(dtype)}")
    return array.astype(dtype, copy=False)


def _check_headers(headers: Mapping[str, archive.Header]) -> None:
    version = headers.get("format_version")
    if version is None or version != (np.dtype(np.int64), ()):
        raise ResultError("it has no format version")
    expected = {"format_version", "files", *_ARRAYS, *_STRINGS}
    optional = {"files"} | (_OPTIONAL - _TRACKS if _TRACKS & set(headers) else _OPTIONAL)
    wrong = sorted((expected - optional - set(headers)) | (set(headers) - expected))
    if wrong:
        raise ResultError(f"arrays are missing or unknown: {', '.join(wrong)}")
    for name, header in headers.items():
        if name in _ARRAYS and header.dtype != np.dtype(_ARRAYS[name][0]):
            raise ResultError(f"{name} has type {header.dtype}; expected {np.dtype(_ARRAYS[name][0])}")
        if name in _STRINGS and header.dtype.kind != "U":
            raise ResultError(f"{name} has type {header.dtype}; expected text")
    _check_shapes({name: header.shape for name, header in headers.items() if name not in ("format_version", "files")})


def _check_shapes(shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ResultError unless every shape is as the tables say."""
    for name in ("depth", "saliency"):
        if name in shapes and (len(shapes[name]) != 3 or 0 in shapes[name]):
            raise ResultError(f"{name} has shape {shapes[name]}; expected (frames, rows, columns), none of them 0")
    sizes: dict[str | int, int] = dict(zip("SHW", shapes["depth"], strict=True))
    if "saliency" in shapes:
        sizes |= dict(zip("hw", shapes["saliency"][1:], strict=True))
    if there := _TRACKS & set(shapes):
        if missing := sorted(_TRACKS - there):
            raise ResultError(f"tracks lack {', '.join(missing)}")
        if len(shapes["track_frames"]) != 1:
            raise ResultError(f"track_frames has shape {shapes['track_frames']}; expected one number per track")
        sizes["Q"] = shapes["track_frames"][0]
    for name, shape in shapes.items():
        dimensions = _ARRAYS[name][1] if name in _ARRAYS else _STRINGS[name]
        expected = tuple(sizes.get(dimension, dimension) for dimension in dimensions)
        if shape != expected:
            raise ResultError(f"{name} has shape {shape}; expected {expected} to go with depth {shapes['depth']}")
    if "saliency" in shapes and (sizes["H"] % sizes["h"] or sizes["W"] % sizes["w"]):
        raise ResultError(
            f"saliency has {sizes['h']} x {sizes['w']} patches, which do not divide {sizes['H']} x {sizes['W']} pixels"
        )


def _json_values(settings: Any) -> dict[str, Any]:
    try:
        values = json.loads(json.dumps(settings, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ResultError(f"settings cannot be written as JSON: {error}") from None
    if not isinstance(values, dict):
        raise ResultError(f"settings is a {type(settings).__name__}; expected a dictionary")
    return values


def _listed(frames: tuple[int, ...], shown: int = 10) -> str:
    listed = ", ".join(map(str, frames[:shown]))
    return f"{listed} and {len(frames) - shown} more" if len(frames) > shown else listed
