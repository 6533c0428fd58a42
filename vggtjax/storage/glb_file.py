"""GLB files, glTF in one binary file: meshes and point clouds by node, whose arrays may be larger than memory.

Arrays are written piece by piece, so a mapped array is never in memory as a whole. Source: the specification of glTF
2.0 (Khronos), sections 3.6 (arrays) and 4.4 (GLB).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from itertools import accumulate
from math import prod
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

POINTS, TRIANGLES = 0, 4  # glTF's names of what a mesh is drawn as
_FLOAT, _UNSIGNED = 5126, 5125  # glTF's names of types
_KINDS = {(): "SCALAR", (3,): "VEC3"}
_PIECE = 1 << 16  # rows that are in memory at once
_WORD = 4  # bytes; chunks of a GLB file are whole words
_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
# Shows colours as they are: without it viewers light the meshes, which are black where there is no light.
_UNLIT = {
    "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}

Convert = Callable[[np.ndarray], np.ndarray]


class _Stored(NamedTuple):
    values: np.ndarray
    convert: Convert
    dtype: np.dtype

    def pieces(self) -> Iterator[np.ndarray]:
        for start in range(0, len(self.values), _PIECE):
            yield np.ascontiguousarray(self.convert(np.asarray(self.values[start : start + _PIECE])), self.dtype)

    @property
    def length(self) -> int:
        return prod(self.values.shape) * self.dtype.itemsize


class GlbFile:
    """A file in the making: add arrays and nodes, then write it. `tree` is glTF's, for what has no method here."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "vggtjax"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "materials": [_UNLIT],
            "extensionsUsed": sorted(_UNLIT["extensions"]),
            "accessors": [],
        }
        self._arrays: list[_Stored] = []

    def array(self, values: np.ndarray, convert: Convert | None = None, *, bounds: bool = False) -> int:
        """Add float32 or uint32 values of one or three columns; return their number.

        Args:
            values: [N] or [N, 3], at least one row; may be mapped.
            convert: what is done with each piece of the values before it is written; the shape stays.
            bounds: note the least and largest value of each column, as positions and times of animations need.
        """
        indices = values.dtype.kind in "iu" and convert is None
        stored = _Stored(values, convert or (lambda piece: piece), np.dtype("<u4" if indices else "<f4"))
        accessor: dict[str, Any] = {
            "bufferView": len(self._arrays),
            "componentType": _UNSIGNED if indices else _FLOAT,
            "count": len(values),
            "type": _KINDS[values.shape[1:]],
        }
        if bounds:
            ends = [(piece.min(axis=0), piece.max(axis=0)) for piece in stored.pieces()]
            lowest, highest = np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)
            accessor |= {"min": np.atleast_1d(lowest).tolist(), "max": np.atleast_1d(highest).tolist()}
        self._arrays.append(stored)
        self.tree["accessors"].append(accessor)
        return len(self._arrays) - 1

    def node(self, name: str, mode: int, attributes: Mapping[str, int], indices: int | None = None) -> int:
        """Add a node with a mesh, drawn as POINTS or TRIANGLES; arrays are given by number. Return its number."""
        part: dict[str, Any] = {"attributes": dict(attributes), "mode": mode, "material": 0}
        part |= {} if indices is None else {"indices": indices}
        number = len(self.tree["nodes"])
        self.tree["nodes"].append({"name": name, "mesh": len(self.tree["meshes"])})
        self.tree["meshes"].append({"name": name, "primitives": [part]})
        self.tree["scenes"][0]["nodes"].append(number)
        return number

    def write(self, path: Path) -> None:
        """Write the file."""
        lengths = [stored.length for stored in self._arrays]
        starts = accumulate(lengths, initial=0)
        views = [{"buffer": 0, "byteOffset": start, "byteLength": n} for start, n in zip(starts, lengths, strict=False)]
        tree = self.tree | {"buffers": [{"byteLength": sum(lengths)}], "bufferViews": views}
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % _WORD)
        with path.open("wb") as file:
            file.write(struct.pack("<III", _MAGIC, _VERSION, 12 + 8 + len(text) + 8 + sum(lengths)))
            file.write(struct.pack("<II", len(text), _JSON) + text)
            file.write(struct.pack("<II", sum(lengths), _BINARY))
            self._write_arrays(file)

    def _write_arrays(self, file: IO[bytes]) -> None:
        for stored in self._arrays:
            for piece in stored.pieces():
                file.write(piece.data)
