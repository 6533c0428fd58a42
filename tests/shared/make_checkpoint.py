"""Write a checkpoint of VGGT's PyTorch layout with seeded weights: python -m tests.shared.make_checkpoint OUT."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.progress import Progress

from tests.shared.seeded import seeded_tensor
from vggtjax.errors import VggtjaxError
from vggtjax.storage.json_values import read_json
from vggtjax.storage.tensor_file import Spec, write_tensors
from vggtjax.storage.writing import staging, writing

VGGT_1B = Path(__file__).parents[1] / "golden" / "shapes_vggt_1b.json"

Shapes = Mapping[str, Sequence[int]]
Make = Callable[[str], np.ndarray]


def main(
    out: Annotated[Path, tyro.conf.Positional],
    shapes: Path = VGGT_1B,
    format: Literal["safetensors", "pt"] = "safetensors",
    shards: int = 1,
    seed: int = 0,
) -> None:
    """Write seeded weights, one tensor in memory at a time.

    Args:
        out: file to write, or folder for several shards.
        shapes: JSON object of parameter names -> shapes; VGGT-1B by default.
        format: of the file; pt needs twice the space while it is written.
        shards: number of safetensors files, with an index.
        seed: of the weights.
    """
    layout = read_json(shapes, dict[str, list[int]], "shapes")
    with Progress() as progress:
        task = progress.add_task(str(out), total=len(layout))
        make_checkpoint(
            out, layout, format=format, shards=shards, seed=seed, on_tensor=lambda _: progress.advance(task)
        )


def make_checkpoint(
    out: Path,
    shapes: Shapes,
    *,
    format: Literal["safetensors", "pt"] = "safetensors",
    shards: int = 1,
    seed: int = 0,
    on_tensor: Callable[[str], object] | None = None,
) -> None:
    """Write the seeded weights of `shapes`, as `main` says; `on_tensor` is called with each name."""

    def make(name: str) -> np.ndarray:
        if on_tensor is not None:
            on_tensor(name)
        return seeded_tensor(name, shapes[name], seed)

    if format == "pt":
        _write_torch(out, shapes, make)
    elif shards == 1:
        _write_safetensors(out, shapes, make)
    else:
        _write_shards(out, shapes, make, shards)


def _write_safetensors(path: Path, shapes: Shapes, make: Make) -> None:
    specs = {name: Spec(tuple(shape), np.dtype(np.float32)) for name, shape in shapes.items()}
    write_tensors(path, specs, lambda name: [make(name)], {"format": "pt"})


def _write_shards(folder: Path, shapes: Shapes, make: Make, shards: int) -> None:
    total = sum(4 * prod(shape) for shape in shapes.values())
    parts: list[dict[str, Sequence[int]]] = [{} for _ in range(shards)]
    done = 0
    for name, shape in shapes.items():
        parts[done * shards // total][name] = shape
        done += 4 * prod(shape)
    weight_map: dict[str, str] = {}
    for number, part in enumerate(parts, 1):
        shard = f"model-{number:05}-of-{shards:05}.safetensors"
        _write_safetensors(folder / shard, part, make)
        weight_map |= dict.fromkeys(part, shard)
    with writing(folder / "model.safetensors.index.json") as temporary:
        temporary.write_text(json.dumps({"metadata": {"total_size": total}, "weight_map": weight_map}, indent=2))


def _write_torch(path: Path, shapes: Shapes, make: Make) -> None:
    import torch

    tensors = {}
    with staging(path.parent) as folder, writing(path) as temporary:
        for number, (name, shape) in enumerate(shapes.items()):  # each stays in a file, not in memory, until saved
            tensors[name] = torch.from_file(f"{folder}/{number}", shared=True, size=prod(shape)).reshape(tuple(shape))
            tensors[name].copy_(torch.from_numpy(make(name)))
        torch.save(tensors, temporary)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, or 2 for bad input or output."""
    try:
        tyro.cli(main, prog="python -m tests.shared.make_checkpoint", args=arguments)
    except VggtjaxError as error:
        sys.stderr.write(f"make_checkpoint: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(run())
