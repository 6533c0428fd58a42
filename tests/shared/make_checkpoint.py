"""Write a checkpoint of VGGT's PyTorch layout with seeded weights: python -m tests.shared.make_checkpoint OUT."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Literal

import numpy as np

from tests.shared.seeded import seeded_state_dict, seeded_tensor
from vggtjax.storage.tensor_file import Spec, write_tensors

VGGT_1B = Path(__file__).parents[1] / "golden" / "shapes_vggt_1b.json"

Shapes = Mapping[str, Sequence[int]]


def make_checkpoint(
    out: Path, shapes: Shapes, *, format: Literal["safetensors", "pt"] = "safetensors", shards: int = 1, seed: int = 0
) -> None:
    """Write the seeded weights of `shapes` into a file, or into a folder for several shards.

    Of safetensors one tensor is in memory at a time.
    """
    if format == "pt":
        import torch

        tensors = seeded_state_dict(shapes, seed)
        torch.save({name: torch.from_numpy(tensor) for name, tensor in tensors.items()}, out)
    elif shards == 1:
        _write_safetensors(out, shapes, seed)
    else:
        _write_shards(out, shapes, shards, seed)


def _write_safetensors(path: Path, shapes: Shapes, seed: int) -> None:
    specs = {name: Spec(tuple(shape), np.dtype(np.float32)) for name, shape in shapes.items()}
    write_tensors(path, specs, lambda name: [seeded_tensor(name, shapes[name], seed)], {"format": "pt"})


def _write_shards(folder: Path, shapes: Shapes, shards: int, seed: int) -> None:
    total = sum(4 * prod(shape) for shape in shapes.values())
    parts: list[dict[str, Sequence[int]]] = [{} for _ in range(shards)]
    done = 0
    for name, shape in shapes.items():
        parts[done * shards // total][name] = shape
        done += 4 * prod(shape)
    weight_map: dict[str, str] = {}
    for number, part in enumerate(parts, 1):
        shard = f"model-{number:05}-of-{shards:05}.safetensors"
        _write_safetensors(folder / shard, part, seed)
        weight_map |= dict.fromkeys(part, shard)
    index = json.dumps({"metadata": {"total_size": total}, "weight_map": weight_map}, indent=2)
    (folder / "model.safetensors.index.json").write_text(index)


if __name__ == "__main__":
    make_checkpoint(Path(sys.argv[1]), json.loads(VGGT_1B.read_text()))
