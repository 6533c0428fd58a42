"""Safetensors files: read through a memory map, written one piece at a time. Does not import jax."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from math import prod
from pathlib import Path
from typing import NamedTuple

import ml_dtypes
import numpy as np
from safetensors import SafetensorError, safe_open

from vggtjax.errors import CheckpointError, one_line, reading
from vggtjax.storage.writing import writing

ALIGNMENT = 64  # bytes; XLA uses aligned tensors of a memory map without a copy
MAX_HEADER_BYTES = 2**24  # VGGT-1B needs 2**18

_PLAIN = ("float64", "float32", "float16", "int64", "int32", "int16", "int8", "uint64", "uint32", "uint16", "uint8")
_DTYPES: dict[str, np.dtype] = {
    **{f"{np.dtype(name).kind.upper()}{8 * np.dtype(name).itemsize}": np.dtype(name) for name in _PLAIN},  # F64 to U8
    "BF16": np.dtype(ml_dtypes.bfloat16),
    "F8_E4M3": np.dtype(ml_dtypes.float8_e4m3fn),
    "F8_E5M2": np.dtype(ml_dtypes.float8_e5m2),
    "C64": np.dtype(np.complex64),
    "BOOL": np.dtype(np.bool_),
}
_CODES = {dtype: code for code, dtype in _DTYPES.items()}


class StoredTensor(NamedTuple):
    """A tensor in a file: `numpy.asarray` maps the tensor into memory, read-only."""

    path: Path
    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor."""
        return prod(self.shape) * self.dtype.itemsize

    def within(self, content: np.ndarray) -> np.ndarray:
        """Return the tensor as a view of the bytes of its whole file."""
        return content[self.offset :][: self.nbytes].view(self.dtype).reshape(self.shape)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        if 0 in self.shape:
            return np.empty(self.shape, dtype or self.dtype)
        mapped = np.memmap(self.path, self.dtype, mode="r", offset=self.offset, shape=self.shape)
        return np.array(mapped, dtype, copy=copy)


class TensorFile(NamedTuple):
    """Header of a safetensors file."""

    tensors: dict[str, StoredTensor]
    metadata: dict[str, str]


class Spec(NamedTuple):
    """Shape and type of a tensor to write."""

    shape: tuple[int, ...]
    dtype: np.dtype


def is_tensor_file(path: str | Path) -> bool:
    """Return whether a file starts as a safetensors file does: eight bytes of length, then JSON."""
    with reading(path, CheckpointError), Path(path).open("rb") as file:
        start = file.read(9)
    return start[8:] == b"{" and int.from_bytes(start[:8], "little") < 2**48  # other formats begin with text


def read_tensors(path: str | Path) -> TensorFile:
    """Read the header of a safetensors file, and check that the file is whole.

    Raises CheckpointError if the file cannot be read, is not a whole safetensors file, or holds an unsupported type.
    """
    path = Path(path)
    with reading(path, CheckpointError), path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if length > MAX_HEADER_BYTES:
            raise CheckpointError(
                f"{path} is not a safetensors file of weights: its header claims {length} bytes; "
                f"expected at most {MAX_HEADER_BYTES}"
            )
        try:
            with safe_open(path, framework="numpy") as opened:
                metadata = opened.metadata() or {}
                slices = {name: opened.get_slice(name) for name in opened.offset_keys()}
                layout = {name: (tuple(piece.get_shape()), piece.get_dtype()) for name, piece in slices.items()}
        except SafetensorError as error:
            words = f"is not a whole safetensors file ({one_line(str(error))}); copy or download it again"
            raise CheckpointError(f"{path} {words}") from None
    if unsupported := sorted({code for _, code in layout.values()} - set(_DTYPES)):
        raise CheckpointError(f"{path} has tensors of type {', '.join(unsupported)}; expected floating point")
    # safe_open has checked that the tensors fill the file without gaps, so their sizes give their offsets.
    offset = 8 + length
    tensors = {}
    for name, (shape, code) in layout.items():
        tensors[name] = StoredTensor(path, offset, shape, _DTYPES[code])
        offset += tensors[name].nbytes
    return TensorFile(tensors, metadata)


def write_tensors(
    path: str | Path,
    specs: Mapping[str, Spec],
    pieces: Callable[[str], Iterable[np.ndarray]],
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write a safetensors file with one piece in memory at a time; an interrupted run leaves no file.

    An existing file is replaced. `pieces` returns the parts of the tensor of a name, consecutive on axis 0, of any
    type: they are cast. Raises OutputError if the folder cannot be written or the disk is full.
    """
    sizes = {name: prod(spec.shape) * spec.dtype.itemsize for name, spec in specs.items()}
    names = sorted(specs, key=lambda name: (sizes[name] % ALIGNMENT != 0, name))  # keeps all but the last ones aligned
    header: dict[str, object] = {"__metadata__": dict(metadata)} if metadata else {}
    total = 0
    for name in names:
        shape, dtype = specs[name]
        end = total + sizes[name]
        header[name] = {"dtype": _CODES[dtype], "shape": list(shape), "data_offsets": [total, end]}
        total = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % ALIGNMENT)

    with writing(path) as temporary:
        with temporary.open("wb") as file:
            file.write(len(text).to_bytes(8, "little") + text)
            for name in names:
                for piece in pieces(name):
                    piece = np.ascontiguousarray(piece, dtype=specs[name].dtype)
                    file.write(piece.reshape(-1).view(np.uint8).data)
        read_tensors(temporary)  # checks that the file is whole
