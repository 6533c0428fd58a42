"""PyTorch VGGT weights -> parameter tree, by the rule table and strictly checked: in memory, or file to file."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np
from flax.traverse_util import unflatten_dict

from converters.rules import IGNORED, RULES, Rule, Transform
from converters.sources import Tensor, Weights, locate, read_state_dict
from vggtjax.checkpoint import DType, Progress, flat_shapes, numpy_dtype, problems_sentence, write_checkpoint
from vggtjax.config import VGGTConfig, vggt_1b
from vggtjax.errors import CheckpointError, InputError
from vggtjax.tensor_file import Spec

_STACKED = {rule.path for rule in RULES if rule.stacked}
_FLOATS = tuple(np.dtype(kind) for kind in (np.float32, ml_dtypes.bfloat16, np.float16, np.float64))


class Piece(NamedTuple):
    """One source tensor of a target array: one layer of a stacked one, or all of it."""

    source: str
    transform: Transform


class Target(NamedTuple):
    """One array of the parameter tree and the tensors that it is made of, in order of layers."""

    shape: tuple[int, ...]
    pieces: list[Piece]
    stacked: bool

    def parts(self, tensors: Mapping[str, Tensor]) -> Iterator[np.ndarray]:
        """Yield the target's parts, consecutive on axis 0, as views of their sources, which are mapped one by one."""
        for piece in self.pieces:
            part = piece.transform(np.asarray(tensors[piece.source]))
            yield part[None] if self.stacked else part


def convert_state_dict(state_dict: Mapping[str, np.ndarray], config: VGGTConfig) -> dict[str, Any]:
    """Return the parameter tree (nested dicts of numpy arrays) of a PyTorch state dict.

    Args:
        state_dict: PyTorch parameter names -> arrays, of any float dtype, which is kept.
        config: the model's configuration.

    Raises:
        CheckpointError: lists every unknown, missing, duplicate and mis-shaped key, and types other than float.
    """
    tensors = {name: np.asarray(value) for name, value in state_dict.items()}
    targets = plan_conversion(tensors, config)
    flat = {path: np.concatenate(list(target.parts(tensors))) for path, target in targets.items()}
    return unflatten_dict(flat, sep=".")


def convert(
    source: str | Path,
    destination: str | Path,
    *,
    dtype: DType = "float32",
    config: VGGTConfig | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the checkpoint of a PyTorch VGGT as one file of this library; return its path.

    One source tensor is in memory at a time.

    Args:
        source: a .safetensors file, a sharded one (its index file or folder), a .pt or .pth file, or a hub id.
        destination: the file to write; one that is there is replaced.
        dtype: of the parameters in the file.
        config: the model's configuration; None for VGGT-1B. Head counts cannot be read off the weights.
        progress: called with the tensors converted and their number.

    Raises:
        CheckpointError: the source cannot be read, or does not fit the configuration; all problems at once.
        OutputError: the destination cannot be written.
        MissingExtraError: the source needs torch or huggingface_hub, which is not installed.
    """
    return convert_weights(locate(source), destination, dtype=dtype, config=config or vggt_1b(), progress=progress)


def convert_weights(
    weights: Weights,
    destination: str | Path,
    *,
    dtype: DType,
    config: VGGTConfig,
    progress: Progress | None = None,
) -> Path:
    """Do what `convert` does with weights that are located."""
    kind = numpy_dtype(dtype)
    destination = Path(destination).expanduser()
    if os.path.isfile(destination) and os.path.samefile(destination, weights.path):  # noqa: PTH113, PTH121
        raise InputError(f"the destination {destination} is the source itself; choose another name")
    tensors, problems = read_state_dict(weights.path)
    targets = plan_conversion(tensors, config, problems)
    total = sum(len(target.pieces) for target in targets.values())
    done = count(1)

    def parts(path: str) -> Iterator[np.ndarray]:
        for part in targets[path].parts(tensors):
            yield part
            if progress is not None:
                progress(next(done), total)

    specs = {path: Spec(target.shape, kind) for path, target in targets.items()}
    return write_checkpoint(destination, specs, parts, config, name=weights.name)


def plan_conversion(
    tensors: Mapping[str, Tensor], config: VGGTConfig, problems: Sequence[str] = ()
) -> dict[str, Target]:
    """Match every tensor with the rule table; return flat target names -> what each is made of.

    Args:
        tensors: by source name; their shapes and types alone are looked at.
        config: the model that the tensors are said to be.
        problems: what the reader found already.

    Raises:
        CheckpointError: lists `problems` and every unknown, missing, duplicate and mis-shaped key.
    """
    shapes = flat_shapes(config)
    problems = list(problems)
    targets: dict[str, Target] = {}
    known = set(IGNORED)
    for path, keys in _expected(shapes).items():
        pieces = []
        for key in keys:
            known.update(key.names)
            found = [name for name in key.names if name in tensors]
            if not found:
                problems.append(f"missing key {key.names[0]}")
            elif len(found) > 1:
                problems.append(f"duplicate keys {' and '.join(found)}: one parameter under two names")
            for name in found:
                if tensors[name].shape != key.shape:
                    problems.append(f"mis-shaped key {name}: {list(tensors[name].shape)}, expected {list(key.shape)}")
                if tensors[name].dtype not in _FLOATS:
                    problems.append(f"key {name} has type {tensors[name].dtype}, expected floating point")
            pieces += [Piece(name, key.transform) for name in found]
        targets[path] = Target(shapes[path], pieces, stacked=path in _STACKED)
    problems += [f"unknown key {name}" for name in tensors if name not in known]
    if problems:
        raise CheckpointError(problems_sentence("the checkpoint does not fit the configuration", problems))
    return targets


def source_shapes(config: VGGTConfig) -> dict[str, tuple[int, ...]]:
    """Return the PyTorch state dict's names -> shapes of a model, as published and without the ignored ones."""
    expected = (key for keys in _expected(flat_shapes(config)).values() for key in keys)
    return {key.names[0]: key.shape for key in expected}


class _Key(NamedTuple):
    """One source tensor: its possible names, its transform, its shape."""

    names: list[str]
    transform: Transform
    shape: tuple[int, ...]


def _expected(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, list[_Key]]:
    """Return the source tensors of every target, in order of layers."""
    rules: dict[str, list[Rule]] = {}
    for rule in RULES:
        rules.setdefault(rule.path, []).append(rule)
    expected = {}
    for path, shape in shapes.items():
        first = rules[path][0]
        layers, part = (range(shape[0]), shape[1:]) if first.stacked else (range(1), shape)
        expected[path] = [
            _Key(
                [rule.source.replace("{layer}", str(layer)) for rule in rules[path]],
                first.transform,
                first.transform.source_shape(part),
            )
            for layer in layers
        ]
    return expected
