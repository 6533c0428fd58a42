"""Files of plain arrays (.npz, .npy): nothing is unpickled, and sizes are checked before arrays are read.

Large arrays that stand uncompressed in an .npz are not read but mapped: their pages are read when they are used.
"""

from __future__ import annotations

import ast
import os
import re
import struct
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from vggtjax.errors import ResultError, check_regular, one_line
from vggtjax.storage.memory import free_bytes

_DEFLATE_LEVEL = 1  # higher levels take several times as long and save a few percent
SIZE_LIMIT = 64 * 2**30  # bytes of all arrays of one file
_MOST_TIMES, _SPARE = 16, 2**26  # of a file's bytes its arrays may have, or so many bytes: masks may be all zero
_LENGTHS = {(1, 0): 2, (2, 0): 4}  # version of the format -> bytes of the length of a header
_MOST_HEADER_BYTES = 2**14
_MOST_AXES = 32
_LEAST_MAPPED = 2**20  # bytes of an array; smaller ones are read
_ALIGNMENT = 64  # bytes; arrays that are mapped start at such places
_LOCAL_HEADER, _ZIP64_BYTES = 30, 20  # bytes of a zip's header before each file, without names; of its sizes of 64 bits
_PADDING = 0xD935  # a zip's name for bytes that align what follows
_MOST_SPREAD = 2**23  # values of a mapped array of which statistics are made
_DESCR = re.compile(r"[<>|=]?(?:[?biufcmM]|[SUV][1-9])\d{0,10}(\[\w{1,10}\])?")
# Exceptions of zipfile, numpy and Python's parser for truncated or damaged files.
_BROKEN = (zipfile.BadZipFile, zlib.error, struct.error, ValueError, EOFError, SyntaxError, RuntimeError, MemoryError)


class Header(NamedTuple):
    """Type and shape of a stored array."""

    dtype: np.dtype
    shape: tuple[int, ...]


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write `arrays` to an .npz file, compressed but for mapped arrays, which are mapped again when they are read."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_DEFLATE_LEVEL) as archive:
        for name, array in arrays.items():
            member: zipfile.ZipInfo | str = f"{name}.npy"
            if is_mapped(array) and archive.fp is not None:
                member = zipfile.ZipInfo(f"{name}.npy")  # is stored, not compressed
                place = archive.fp.tell() + _LOCAL_HEADER + len(member.filename) + _ZIP64_BYTES + 4
                padding = -place % _ALIGNMENT
                member.extra = struct.pack("<HH", _PADDING, padding) + bytes(padding)
            with archive.open(member, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asarray(array, order="C"), allow_pickle=False)


def is_mapped(array: object) -> bool:
    """Return whether an array is a mapped file: as large as a disk, and read when it is used."""
    return isinstance(array, np.memmap)


def zeros_beside(array: np.ndarray, dtype: type, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Return zeros of an array's shape: in memory, or for a mapped array in a file without a name.

    The file lies in the folder of the mapped one where that can be written: a system's folder for temporary files may
    itself be memory.
    """
    shape = array.shape if shape is None else shape
    if not isinstance(array, np.memmap) or not prod(shape):
        return np.zeros(shape, dtype)
    folder = None if array.filename is None else Path(array.filename).parent
    if folder is not None and not os.access(folder, os.W_OK):
        folder = None
    with tempfile.TemporaryFile(dir=folder) as file:  # the map keeps it open
        return np.memmap(file, dtype, "w+", shape=shape)


def spread_frames(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return what statistics are made of: the arrays, or some of their frames, evenly spread, where they are mapped.

    Of a mapped array about 2**23 values are taken; all arrays have the frames of the first.
    """
    first = arrays[0]
    if not is_mapped(first) or first.size <= _MOST_SPREAD:
        return arrays
    count = max(1, _MOST_SPREAD // (first.size // len(first)))
    chosen = np.linspace(0, len(first) - 1, count).round().astype(int)
    return tuple(np.asarray(array[chosen]) for array in arrays)


def read_headers(path: Path) -> dict[str, Header]:
    """Return name -> type and shape of the arrays in an .npz file, without reading the arrays.

    Raises ResultError for a file that is not a whole .npz, holds Python objects, exceeds SIZE_LIMIT, or declares more
    bytes than an archive of its size can honestly hold. The message says "it"; the caller names the file.
    """
    with _opened(path) as archive:
        return {name: _read_header(file, member.filename, member.file_size) for name, member, file in _members(archive)}


def read_array(path: Path) -> np.ndarray:
    """Return the array of an .npy file; raises ResultError as `read_headers` does."""
    check_regular(path, ResultError)
    with _explaining(path.name, ".npy"), path.open("rb") as file:
        size = path.stat().st_size
        if size > SIZE_LIMIT:
            raise ResultError(f"{path.name} has {size} bytes; expected at most {SIZE_LIMIT}")
        _read_header(file, path.name, size)
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)


def read_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Return all arrays of an .npz file, or those with these names; raises ResultError as `read_headers` does.

    Those that stand uncompressed and take 1 MB or more are mapped. They may be written to; the file stays as it is.
    ResultError too where the others take more memory than is free.
    """
    arrays = {}
    with _opened(path) as archive:
        needed = sum(
            member.file_size
            for member in archive.infolist()
            if not _is_mappable(member) and (names is None or member.filename.removesuffix(".npy") in names)
        )
        if needed > _SPARE and (free := free_bytes()) is not None and needed > free:
            raise ResultError(
                f"its arrays take {needed} bytes of memory and {free:.0f} are free; free some, or take fewer"
            )
        for name, member, file in _members(archive):
            if names is not None and name not in names:
                continue
            header = _read_header(file, member.filename, member.file_size)
            if _is_mappable(member) and header.dtype.kind != "S":  # bytes are read
                arrays[name] = _mapped(path, member, file.tell(), header)
                continue
            file.seek(0)
            array = np.lib.format.read_array(file, allow_pickle=False)
            if array.dtype.kind == "U" and (np.atleast_1d(array).view(np.uint32) > sys.maxunicode).any():
                raise ResultError(f"{member.filename} holds text that is not Unicode")
            arrays[name] = array
    return arrays


def _is_mappable(member: zipfile.ZipInfo) -> bool:
    return member.compress_type == zipfile.ZIP_STORED and member.file_size >= _LEAST_MAPPED


def _mapped(path: Path, member: zipfile.ZipInfo, offset: int, header: Header) -> np.ndarray:
    """Return an array that stands uncompressed in a zip, `offset` bytes into its file, as a mapped file."""
    with path.open("rb") as file:
        file.seek(member.header_offset)
        local = file.read(_LOCAL_HEADER)
    if len(local) < _LOCAL_HEADER or header.dtype.kind not in "biuf":
        raise ResultError(f"{member.filename} is not a whole array of numbers")
    names = sum(struct.unpack("<HH", local[26:]))
    place = member.header_offset + _LOCAL_HEADER + names + offset
    if place + prod(header.shape) * header.dtype.itemsize > path.stat().st_size:
        raise ResultError(f"{member.filename} ends after the file does; it is not a whole .npz file")
    return np.memmap(path, header.dtype, "c", place, header.shape)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an .npz file and hold its declared sizes against its own; errors of the body say "it"."""
    with _explaining("it", ".npz"):
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ResultError("it is a pipe, a socket or a device; expected an .npz file")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size, total = path.stat().st_size, sum(member.file_size for member in members)
            stored = [member for member in members if member.compress_type == zipfile.ZIP_STORED]
            if total > SIZE_LIMIT:
                raise ResultError(f"its arrays take {total} bytes; expected at most {SIZE_LIMIT}")
            if total > max(_SPARE, _MOST_TIMES * size) or any(m.file_size != m.compress_size for m in stored):
                raise ResultError(
                    f"it has {size} bytes and says that its arrays take {total}; expected at most {_MOST_TIMES} times "
                    "as many: it is damaged, or made to fill the memory"
                )
            yield archive


@contextmanager
def _explaining(subject: str, suffix: str) -> Iterator[None]:
    try:
        yield
    except ResultError:
        raise
    except OSError as error:
        raise ResultError(f"{subject} cannot be read ({error.strerror or error})") from error
    except _BROKEN as error:
        raise ResultError(f"{subject} is not a whole {suffix} file ({one_line(str(error), 200)})") from error


def _members(archive: zipfile.ZipFile) -> Iterator[tuple[str, zipfile.ZipInfo, IO[bytes]]]:
    members = archive.infolist()
    if len({member.filename for member in members}) < len(members):
        raise ResultError("it holds two arrays of the same name")
    for member in members:
        name = member.filename.removesuffix(".npy")
        shown = one_line(member.filename, 80)
        if name == member.filename:
            raise ResultError(f"it holds {shown!r}; expected arrays alone")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ResultError(f"{shown} has compression type {member.compress_type}; expected numpy's: 0 or 8")
        with archive.open(member) as file:
            yield name, member, file


def _read_header(file: IO[bytes], name: str, length: int) -> Header:
    """Return the header at the start of `length` bytes; the array must fill the remaining bytes."""
    name = one_line(name, 80)
    version = np.lib.format.read_magic(file)
    if version not in _LENGTHS:
        raise ResultError(f"{name} has version {version} of the array format; expected (1, 0) or (2, 0)")
    header_length = int.from_bytes(file.read(_LENGTHS[version]), "little")
    if header_length > _MOST_HEADER_BYTES:
        raise ResultError(f"{name} has a header of {header_length} bytes; expected at most {_MOST_HEADER_BYTES}")
    try:
        header = ast.literal_eval(file.read(header_length).decode("latin1"))
        descr, by_columns, shape = (header.pop(key) for key in ("descr", "fortran_order", "shape"))
        is_valid = not header and type(by_columns) is bool and type(shape) is tuple and len(shape) <= _MOST_AXES
        if not (is_valid and all(type(side) is int and 0 <= side <= SIZE_LIMIT for side in shape)):
            raise ValueError
    except (*_BROKEN, TypeError, LookupError, AttributeError):
        raise ResultError(f"{name} has an invalid header; expected one as numpy writes it") from None
    if type(descr) is not str or "O" in descr:
        raise ResultError(f"{name} holds Python objects or structures, which are never loaded; expected plain values")
    try:
        dtype = np.dtype(descr if _DESCR.fullmatch(descr) else "")
    except (TypeError, ValueError):
        raise ResultError(f"{name} has the type {descr[:50]!r}; expected numbers, booleans or text") from None
    if not dtype.isnative:
        raise ResultError(f"{name} has the type {dtype} in foreign byte order; save the array with native byte order")
    if by_columns and len(shape) > 1:
        raise ResultError(f"{name} is stored in column order; expected row order")
    size = prod(shape) * dtype.itemsize
    if size != length - file.tell():
        raise ResultError(f"{name} has {length - file.tell()} bytes of values; its header says {size}")
    return Header(dtype, shape)
