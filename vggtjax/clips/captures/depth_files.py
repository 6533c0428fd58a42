"""Files of one depth map each: 16-bit PNG, Sintel's .dpt, .npy, OpenEXR. Does not import jax."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from vggtjax.clips.captures.files import read_bytes
from vggtjax.clips.captures.pictures import PNG, opening
from vggtjax.errors import InputError, ResultError, check_extra, check_regular, one_line
from vggtjax.storage.arrays import read_array, read_arrays, read_headers

SINTEL_TAG = b"PIEH"  # the float 202021.25, little-endian: the first bytes of .dpt and .cam
_DPT_HEADER = 12  # bytes: the tag, width, height
_MOST_PIXELS = 10**8  # of an OpenEXR file
_SIXTEEN_BITS = ("I;16", "I;16B", "I")


def read_png(path: Path, per_metre: float, invalid: int = 0) -> Float32[np.ndarray, "h w"]:
    """Read a PNG of 16 bits: metres, 0 where the file has 0 or `invalid`.

    Raises InputError for any other file.
    """
    with opening(path, PNG) as image:
        if image.mode not in _SIXTEEN_BITS:
            raise InputError(f"{path} has pixels of kind {image.mode}; expected one channel of 16 bits")
        values = np.asarray(image)
    return np.where(values == invalid, 0, values).astype(np.float32) / np.float32(per_metre)


def read_dpt(path: Path) -> Float32[np.ndarray, "h w"]:
    """Read a depth map of MPI Sintel: metres along z.

    A tag, width and height as 32-bit integers, then rows of 32-bit floats, all little-endian (MPI Sintel depth training
    data, `sintel_io.py`). Raises InputError for a file of another length than its header says.
    """
    data = read_bytes(path)
    if data[:4] != SINTEL_TAG or len(data) < _DPT_HEADER:
        raise InputError(f"{path} starts with {data[:4]!r}; expected the tag {SINTEL_TAG!r} of a Sintel depth map")
    width, height = (int(side) for side in np.frombuffer(data, "<i4", 2, offset=4))
    if min(width, height) <= 0 or len(data) != _DPT_HEADER + 4 * width * height:
        raise InputError(f"{path} has {len(data)} bytes; its header says {width} x {height} pixels of 4 bytes each")
    return np.frombuffer(data, "<f4", offset=_DPT_HEADER).reshape(height, width).astype(np.float32)


def read_npy(path: Path, per_unit: float = 1) -> Float32[np.ndarray, "h w"]:
    """Read an .npy of shape (h, w), beside axes of length 1, without a unit; whole numbers are `per_unit` a unit.

    Raises InputError for anything else.
    """
    return _one_map(read_array(path), path, per_unit)


def read_npz(path: Path, per_unit: float = 1) -> Float32[np.ndarray, "h w"]:
    """Read the array `depth` of an .npz, or its only array, as `read_npy` reads one.

    Raises InputError for anything else.
    """
    try:
        names = list(read_headers(path))
        if "depth" not in names and len(names) != 1:
            raise InputError(
                f"{path} has the arrays {one_line(', '.join(names), 80)}; expected one, or one named depth"
            )
        name = "depth" if "depth" in names else names[0]
        values = read_arrays(path, [name])[name]
    except ResultError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    return _one_map(values, path, per_unit)


def _one_map(values: np.ndarray, path: Path, per_unit: float) -> Float32[np.ndarray, "h w"]:
    shape = values.shape
    for axis in reversed(range(values.ndim)):
        if values.ndim > 2 and values.shape[axis] == 1:
            values = values.squeeze(axis)
    if values.ndim != 2 or 0 in shape or values.dtype.kind not in "fiu":
        raise InputError(f"{path} has shape {shape} of {values.dtype}; expected numbers of shape (h, w)")
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, which is unknown
        values = values.astype(np.float32) if values.dtype.kind == "f" else values
    return values.astype(np.float32) / np.float32(1 if values.dtype.kind == "f" else per_unit)


def read_exr(path: Path) -> Float32[np.ndarray, "h w"]:
    """Read an OpenEXR file of one channel without a unit; needs the extra 'exr'.

    Raises InputError for anything else, MissingExtraError without the library.
    """
    check_extra("depth in OpenEXR files", "exr", "OpenEXR")
    import OpenEXR

    check_regular(path)
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        if len(header["channels"]) != 1:  # before they are decoded
            names = ", ".join(channel.name for channel in header["channels"])
            raise InputError(f"{path} has the channels {one_line(names)}; expected one, of depth")
        lowest, highest = header["dataWindow"]
        width, height = (int(side) for side in highest.astype(np.int64) - lowest + 1)
        if not 0 < width * height <= _MOST_PIXELS or width < 1:
            raise InputError(f"{path} has {width} x {height} pixels; expected at most {_MOST_PIXELS}")
        (channel,) = OpenEXR.File(str(path), separate_channels=True).channels().values()
        return np.asarray(channel.pixels, np.float32).reshape(height, width)
    except InputError:
        raise
    except (RuntimeError, LookupError, TypeError, AttributeError, ValueError) as error:  # ValueError: names, no part
        raise InputError(f"{path} is not an OpenEXR file that can be read: {error}") from None
