"""Record3D: a .r3d file, which is a zip, the folder that it unpacks to, or an export "EXR + JPG". Does not import jax.

`metadata` is JSON: w and h of the pictures, dw and dh of the depth, K (three columns of three), perFrameIntrinsicCoeffs
(fx fy cx cy a frame), poses (qx qy qz qw tx ty tz a frame, world-from-camera in ARKit's axes: the camera looks along
-z, in metres), frameTimestamps or fps. rgbd/N.jpg are the pictures, rgbd/N.depth their depth in metres and rgbd/N.conf
its confidence, 0 where it is low, both compressed with LZFSE. An export "EXR + JPG", as nerfstudio takes it, has
metadata.json, rgb/N.jpg (or .png) and depth/N.exr, without a confidence. Pixels are taken to count from the outer
corner of the first. https://github.com/marek-simonik/record3d/issues/93
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from vggtjax.clips.captures.cameras import PIXEL_CENTRE, checked_intrinsics, from_opengl, intrinsics_matrix
from vggtjax.clips.captures.capture import Capture, checked_sizes, fitted_intrinsics
from vggtjax.clips.captures.depth_files import read_exr
from vggtjax.clips.captures.files import files, read_bytes
from vggtjax.clips.captures.numbers import number, numbers
from vggtjax.clips.captures.unpacked import Unpacked, unpacked
from vggtjax.errors import InputError, check_extra
from vggtjax.storage.json_values import read_json
from vggtjax.storage.trajectories import pose_matrices


class _Layout(NamedTuple):
    metadata: str
    pictures: str
    depth: str  # of the picture N.jpg, N.png


_OWN, _EXPORT = _Layout("metadata", "rgbd", "rgbd/{}.depth"), _Layout("metadata.json", "rgb", "depth/{}.exr")
_MOST_BYTES = 2**26
_SHAPES = ((256, 192), (640, 480))  # of depth upright, in files without dw and dh: of the lidar, of the front camera
_MOST_SIDE = 10_000  # pixels of a depth map
_MARK = b"bvx"  # every block of LZFSE starts with it
_HEADER = 16  # bytes of the shortest file
_BLOCK_BYTES = 40_000  # that LZFSE's compressor fills a block with, at least
_SPARE_BLOCKS = 8


def is_record3d(folder: Path) -> bool:
    """Return whether a folder has the names of either layout."""
    own = (folder / _OWN.metadata).is_file() and (folder / _OWN.pictures).is_dir()
    first = [folder / _EXPORT.pictures / name for name in ("0.jpg", "0.png")]  # which other data sets lack
    return own or ((folder / _EXPORT.metadata).is_file() and any(map(Path.is_file, first)))


def read_record3d(path: Path, *, whole: bool = True) -> Capture:
    """Read a .r3d file, the folder that it unpacks to, or an export "EXR + JPG".

    Depth needs the extra 'record3d', that of an export the extra 'exr', and only when it is read.
    """
    if path.is_dir():
        return _read(path, path, None, whole=whole)
    archive = unpacked(path, (_OWN.metadata, _OWN.pictures))
    with archive.named(path):
        return _read(path, archive.folder, archive, whole=whole)


def _read(path: Path, folder: Path, archive: Unpacked | None, *, whole: bool) -> Capture:
    layout = _OWN if (folder / _OWN.metadata).is_file() else _EXPORT
    source = folder / layout.metadata
    values = read_json(source, dict[str, Any], "metadata", most_bytes=_MOST_BYTES)
    named = files(folder / layout.pictures, ".png") | files(folder / layout.pictures, ".jpg")
    numbered = {int(name): file for name, file in named.items() if name.isdecimal()}
    taken = sorted(numbered)
    pictures = tuple(numbered[number] for number in taken)
    poses = numbers(values, "poses", ((-1, 7),), source)
    count = len(pictures) if whole else len(poses)
    if not taken or len(poses) != count or (taken != list(range(count)) if whole else taken[-1] >= count):
        expected = f"{layout.pictures}/0.jpg and so on, one each"
        raise InputError(f"{path} has {len(pictures)} pictures and {len(poses)} poses; expected {expected}")
    sizes = checked_sizes(pictures, source)
    size = (int(number(values, "w", source)), int(number(values, "h", source)))
    if min(size) < 1:
        raise InputError(f"{source} has pictures of {size[0]} x {size[1]} pixels; expected sizes above 0")
    depths = [folder / layout.depth.format(file.stem) for file in pictures]
    there = [file if file.is_file() else None for file in depths]
    return Capture(
        "record3d",
        path,
        pictures,
        sizes,
        fitted_intrinsics(list(_intrinsics(values, count, source)[taken]), [size] * len(taken), sizes, source),
        from_opengl(pose_matrices(poses[taken, 4:], poses[taken, :4], source), source),
        metric=True,
        depth_files=tuple(there) if any(there) else None,
        read_depth_file=partial(_read_depth, shape=_depth_shape(values, size, source)),
        timestamps=None if (times := _times(values, count, source)) is None else times[taken],
        absent=tuple(str(number) for number in range(count) if number not in numbered),
        archive=archive,
    )


def _intrinsics(values: dict[str, Any], count: int, source: Path) -> Float64[np.ndarray, "S 3 3"]:
    if values.get("perFrameIntrinsicCoeffs"):
        rows = numbers(values, "perFrameIntrinsicCoeffs", ((count, 4),), source)
        return np.stack([intrinsics_matrix(*row, first_pixel=PIXEL_CENTRE, source=source) for row in rows.tolist()])
    matrix = numbers(values, "K", ((9,), (3, 3)), source).reshape(3, 3).T
    return np.tile(checked_intrinsics(matrix, source), (count, 1, 1))


def _times(values: dict[str, Any], count: int, source: Path) -> Float64[np.ndarray, " S"] | None:
    if values.get("frameTimestamps"):
        times = numbers(values, "frameTimestamps", ((count,),), source)
    elif values.get("fps"):
        times = np.arange(count) / number(values, "fps", source)
    else:
        return None
    return times if (np.diff(times) > 0).all() else None


def _depth_shape(values: dict[str, Any], size: tuple[int, int], source: Path) -> tuple[int, int] | None:
    """Return rows and columns of the depth maps; None where the file does not say them."""
    if "dw" not in values or "dh" not in values:
        return None
    width, height = int(number(values, "dw", source)), int(number(values, "dh", source))
    if not 0 < min(width, height) <= max(width, height) <= _MOST_SIDE:
        raise InputError(f"{source} has depth of {width} x {height} pixels; expected sides of 1 to {_MOST_SIDE}")
    return height, width


def _read_depth(path: Path, shape: tuple[int, int] | None) -> Float32[np.ndarray, "h w"]:
    """Read metres, 0 where the confidence is low."""
    if path.suffix == ".exr":
        return read_exr(path)
    check_extra("the depth of a Record3D capture", "record3d", "lzfse")
    depth = _decompressed(path, [shape] if shape else list(_SHAPES), np.dtype("<f4"))
    confidence = path.with_suffix(".conf")
    if not confidence.is_file():
        return depth
    sure = _decompressed(confidence, [depth.shape], np.dtype(np.uint8)) > 0
    return np.where(sure, depth, np.float32(0))


def _decompressed(path: Path, shapes: list[tuple[int, ...]], dtype: np.dtype) -> np.ndarray:
    """Return an array that is compressed with LZFSE and has one of the shapes.

    The library has no limit, so the blocks are counted before: one of 100 bytes can hold 26 MB.
    """
    import lzfse

    data = read_bytes(path)
    most = max(int(np.prod(shape)) for shape in shapes) * dtype.itemsize
    if len(data) < _HEADER or data[:3] != _MARK or data.count(_MARK) > most // _BLOCK_BYTES + _SPARE_BLOCKS:
        raise InputError(f"{path} is not a map of at most {most} bytes that Record3D compressed with LZFSE")
    try:
        values = lzfse.decompress(data)
    except (lzfse.error, MemoryError):
        raise InputError(f"{path} cannot be decompressed; get the capture whole") from None
    for shape in shapes:
        if len(values) == int(np.prod(shape)) * dtype.itemsize:
            return np.frombuffer(values, dtype).reshape(shape)
    expected = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
    raise InputError(f"{path} holds {len(values)} bytes; expected {expected} values of {dtype.itemsize} bytes")
