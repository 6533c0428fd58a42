"""Files of PyTorch weights: chosen by name, recognised by content, read through memory maps."""

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
_CHOICES = (r"model\.safetensors", ".*" + re.escape(INDEX), r".*\.safetensors", r".*\.pth?")  # first choice first
_FILE_NAME = re.compile(r"(?!\.)[^/\\:\x00-\x1f]{1,255}")
_OTHERS = {rb"\Z": "empty", rb"version https://git-lfs": "a Git LFS pointer", rb"\s*<": "a web page"}  # by start


class StateDict(NamedTuple):
    """Tensors by name, not yet read from their files, and problems of their storage."""

    tensors: Mapping[str, Tensor]
    problems: Sequence[str] = ()


def choose_file(names: Sequence[str], place: str) -> str:
    """Return the file of weights to read in a folder or repository.

    model.safetensors comes first, then the index of shards, other .safetensors files, and torch files. Raises
    CheckpointError if the first kind that exists has several files, or if no kind exists.
    """
    names = sorted(name for name in names if not name.startswith(".") and "/" not in name)
    groups = ([name for name in names if re.fullmatch(kind, name, re.DOTALL)] for kind in _CHOICES)
    candidates = next(filter(None, groups), [])
    if len(candidates) != 1:
        held = f"{len(candidates)} files of weights ({', '.join(candidates[:5])})" if candidates else "no weights"
        raise CheckpointError(f"{place} holds {held}; expected one of {', '.join('*' + s for s in SUFFIXES)}")
    return candidates[0]


def weight_files(path: Path) -> list[Path]:
    """Return the files that `read_state_dict` reads: `path` and, if `path` is an index, its shards."""
    if not path.name.endswith(INDEX):
        return [path]
    return [path, *(path.parent / shard for shard in sorted(set(_weight_map(path).values())))]


def read_state_dict(path: Path) -> StateDict:
    """Return the tensors of a file of weights, whose format is recognised by content.

    Raises CheckpointError for an unreadable file and for other formats, MissingExtraError for a torch file if torch is
    not installed.
    """
    if path.name.endswith(INDEX):
        return _read_shards(path)
    if is_tensor_file(path):
        tensors, metadata = read_tensors(path)
        if metadata.get("format") == "vggtjax":
            raise CheckpointError(f"{path} is already a checkpoint of this library; use it without conversion")
        return StateDict(tensors)
    with path.open("rb") as file:
        start = file.read(64)
    if start.startswith((b"PK\x03\x04", b"\x80")):  # an archive, or a pickle of torch before 1.6
        from converters.torch_file import read_torch

        return StateDict(*read_torch(path))
    kinds = (kind for pattern, kind in _OTHERS.items() if re.match(pattern, start))
    kind = next(kinds, f"a file that starts with {start[:8]!r}")
    raise CheckpointError(f"{path} is {kind}, not weights; copy or download it again")


def _read_shards(index: Path) -> StateDict:
    weight_map = _weight_map(index)
    shards = sorted(set(weight_map.values()))
    missing = [f"missing shard {name}" for name in shards if not (index.parent / name).is_file()]
    if missing:
        raise CheckpointError(problems_sentence(f"{index} names shards that are not in its folder", missing))
    tensors: dict[str, StoredTensor] = {}
    holders: dict[str, list[str]] = {name: [] for name in weight_map}
    for shard in shards:
        for name, tensor in read_tensors(index.parent / shard).tensors.items():
            tensors.setdefault(name, tensor)
            holders.setdefault(name, []).append(shard)
    problems = []
    for name, shards in holders.items():
        if not shards:
            problems.append(f"key {name} of the index is in no shard")
        elif len(shards) > 1:
            problems.append(f"duplicate key {name} in {' and '.join(shards)}")
        elif weight_map.get(name) != shards[0]:
            problems.append(f"key {name} is in {shards[0]}; the index says {weight_map.get(name, 'nothing')}")
    return StateDict(tensors, problems)


def _weight_map(index: Path) -> dict[str, str]:
    content = read_json(index, dict[str, Any], "the index", error=CheckpointError)
    weight_map = content.get("weight_map")
    if not isinstance(weight_map, dict) or not weight_map:
        raise CheckpointError(f"{index} has no weight_map; expected one from keys to shards")
    shards = weight_map.values()
    invalid = {str(shard)[:100] for shard in shards if not (isinstance(shard, str) and _FILE_NAME.fullmatch(shard))}
    if invalid:
        raise CheckpointError(f"{index} names shards {sorted(invalid)[:3]}; expected names of files in its folder")
    return weight_map
