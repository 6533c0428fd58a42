"""Files of PyTorch weights: chosen by name, known by their content, read through memory maps."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vggtjax.errors import CheckpointError, problems_sentence
from vggtjax.storage.json_values import read_json
from vggtjax.storage.tensor_file import StoredTensor, is_tensor_file, read_tensors

INDEX = ".safetensors.index.json"
SUFFIXES = (".safetensors", INDEX, ".pt", ".pth")

Tensor = np.ndarray | StoredTensor


class StateDict(NamedTuple):
    """Tensors by name, not yet read from their files, and what is wrong with the way they are stored."""

    tensors: Mapping[str, Tensor]
    problems: Sequence[str] = ()


def choose_file(names: Sequence[str], place: str) -> str:
    """Return which of the files of a folder or repository to read: safetensors before the index of shards before torch.

    Raises CheckpointError if there is none, or no telling which.
    """
    names = sorted(name for name in names if not name.startswith(".") and "/" not in name)
    groups = [
        [name for name in names if name == "model.safetensors"],
        [name for name in names if name.endswith(INDEX)],
        [name for name in names if name.endswith(".safetensors")],
        [name for name in names if name.endswith((".pt", ".pth"))],
    ]
    found = next((group for group in groups if group), [])
    if len(found) != 1:
        said = f"{len(found)} files of weights ({', '.join(found[:5])})" if found else "no weights"
        raise CheckpointError(f"{place} holds {said}; expected one of {', '.join('*' + s for s in SUFFIXES)}")
    return found[0]


def weight_files(path: Path) -> list[Path]:
    """Return the files that `read_state_dict` reads: the given one and, if that is an index, its shards."""
    if not path.name.endswith(INDEX):
        return [path]
    return [path, *(path.parent / shard for shard in sorted(set(_weight_map(path).values())))]


def read_state_dict(path: Path) -> StateDict:
    """Find the tensors of a file of weights, by its content.

    Raises:
        CheckpointError: it cannot be read, or is none of the formats.
        MissingExtraError: it is a torch file, and torch is not installed.
    """
    if path.name.endswith(INDEX):
        return _read_shards(path)
    if is_tensor_file(path):
        tensors, metadata = read_tensors(path)
        if metadata.get("format") == "vggtjax":
            raise CheckpointError(f"{path} is a checkpoint of this library already; there is nothing to convert")
        return StateDict(tensors)
    with path.open("rb") as file:
        start = file.read(64)
    if start.startswith((b"PK\x03\x04", b"\x80")):  # an archive, or before torch 1.6 a pickle
        from converters.torch_file import read_torch

        return StateDict(*read_torch(path))
    raise CheckpointError(f"{path} is {_nature(start)}, not weights; copy or download it again")


def _read_shards(index: Path) -> StateDict:
    weight_map = _weight_map(index)
    shards = sorted(set(weight_map.values()))
    missing = [f"missing shard {name}" for name in shards if not (index.parent / name).is_file()]
    if missing:
        raise CheckpointError(problems_sentence(f"{index} names shards that are not beside it", missing))
    tensors: dict[str, StoredTensor] = {}
    holders: dict[str, list[str]] = {name: [] for name in weight_map}
    for shard in shards:
        for name, tensor in read_tensors(index.parent / shard).tensors.items():
            tensors.setdefault(name, tensor)
            holders.setdefault(name, []).append(shard)
    problems = []
    for name, found in holders.items():
        if not found:
            problems.append(f"key {name} of the index is in no shard")
        elif len(found) > 1:
            problems.append(f"duplicate key {name} in {' and '.join(found)}")
        elif weight_map.get(name) != found[0]:
            problems.append(f"key {name} is in {found[0]}, but in {weight_map.get(name, 'none')} by the index")
    return StateDict(tensors, problems)


def _weight_map(index: Path) -> dict[str, str]:
    content = read_json(index, dict[str, Any], "the index", error=CheckpointError)
    weight_map = content.get("weight_map")
    if not isinstance(weight_map, dict) or not weight_map:
        raise CheckpointError(f"{index} has no weight_map from keys to shards")
    strange = sorted({str(shard)[:100] for shard in weight_map.values() if not _is_file_name(shard)})
    if strange:
        raise CheckpointError(f"{index} names shards {strange[:3]}; expected names of files beside it")
    return weight_map


def _is_file_name(name: object) -> bool:
    return isinstance(name, str) and re.fullmatch(r"(?!\.)[^/\\:\x00-\x1f]{1,255}", name) is not None


def _nature(start: bytes) -> str:
    if not start:
        return "empty"
    if start.startswith(b"version https://git-lfs"):
        return "a pointer of Git LFS to the file that was meant"
    if start.lstrip().startswith(b"<"):
        return "a web page"
    return f"a file that starts with {start[:8]!r}"
