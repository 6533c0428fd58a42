"""Files of one depth map each: 16-bit PNG, Sintel's .dpt, .npy. Does not import jax."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.folders import read_bytes
from vggtjax.evaluation.datasets.pictures import PNG, opening
from vggtjax.storage.arrays import read_array

SINTEL_TAG = b"PIEH"  # the float 202021.25, little-endian: the first bytes of .dpt and .cam
_DPT_HEADER = 12  # bytes: the tag, width, height
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


def read_npy(path: Path) -> Float32[np.ndarray, "h w"]:
    """Read an .npy of shape (h, w) or (h, w, 1) without a unit; raises InputError for anything else."""
    values = read_array(path)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise InputError(f"{path} has shape {values.shape} of {values.dtype}; expected (h, w) or (h, w, 1) of numbers")
    return values.astype(np.float32)
