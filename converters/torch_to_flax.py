"""PyTorch VGGT weights -> parameter tree: the plan that the rule table makes for a set of tensors, strictly checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from converters.rules import RULES, Transform
from vggtjax.config import VGGTConfig
from vggtjax.errors import CheckpointError


class Piece(NamedTuple):
    """One source tensor of a target array (one layer of a stacked one, or all of it)."""

    source: str
    transform: Transform


class Target(NamedTuple):
    """One array of the parameter tree and the tensors that it is made of, in order of layers."""

    shape: tuple[int, ...]
    pieces: list[Piece]


def plan_conversion(shapes: Mapping[str, tuple[int, ...]], config: VGGTConfig) -> dict[str, Target]:
    """Match every tensor name with the rule table; return flat target names -> what each is made of.

    Args:
        shapes: source names -> shapes.
        config: the model that the tensors are said to be.

    Raises:
        CheckpointError: lists every unknown, missing, duplicate and mis-shaped key.
    """
    expected = flat_shapes(config)
    found: dict[tuple[str, int | None], Piece] = {}
    problems: list[str] = []
    for name, shape in shapes.items():
        matches = [(rule, match) for rule in RULES if (match := rule.pattern.fullmatch(name))]
        if len(matches) != 1:
            problems.append(f"unknown key {name}" if not matches else f"{name} matches {len(matches)} rules")
            continue
        rule, match = matches[0]
        if rule.path is None:
            continue
        layer = int(match["layer"]) if "layer" in rule.pattern.groupindex else None
        if rule.path not in expected or (layer is not None and layer >= expected[rule.path][0]):
            problems.append(f"unknown key {name} (this configuration has no {rule.path} for it)")
            continue
        if (rule.path, layer) in found:
            problems.append(f"duplicate key {name}: {found[rule.path, layer].source} is the same parameter")
            continue
        found[rule.path, layer] = Piece(name, rule.transform)
        wanted = expected[rule.path] if layer is None else expected[rule.path][1:]
        if problem := _shape_problem(shape, rule.transform, wanted):
            problems.append(f"mis-shaped key {name}: {problem}")

    stacked = {path for path, layer in found if layer is not None} | {path for path in expected if "blocks." in path}
    stacked |= {path for path in expected if ".trunk." in path}
    targets = {}
    for path, shape in expected.items():
        layers = range(shape[0]) if path in stacked else [None]
        missing = [layer for layer in layers if (path, layer) not in found]
        problems += [f"missing key for {path}" + ("" if layer is None else f", layer {layer}") for layer in missing]
        if not missing:
            targets[path] = Target(shape, [found[path, layer] for layer in layers])
    if problems:
        shown = "; ".join(problems[:20]) + (f"; and {len(problems) - 20} more" if len(problems) > 20 else "")
        raise CheckpointError(f"the checkpoint does not fit the configuration: {len(problems)} problems: {shown}")
    return targets


def convert_state_dict(state_dict: Mapping[str, np.ndarray], config: VGGTConfig) -> dict[str, Any]:
    """Return the parameter tree (nested dicts of numpy arrays) of a PyTorch state dict.

    Args:
        state_dict: PyTorch parameter names -> arrays, of any float dtype, which is kept.
        config: the model's configuration.

    Raises:
        CheckpointError: lists every unknown, missing, duplicate and mis-shaped key.
    """
    targets = plan_conversion({name: tuple(value.shape) for name, value in state_dict.items()}, config)
    flat = {}
    for path, (shape, pieces) in targets.items():
        arrays = [piece.transform(np.asarray(state_dict[piece.source])) for piece in pieces]
        flat[path] = np.stack(arrays).reshape(shape) if len(arrays) > 1 else np.ascontiguousarray(arrays[0]).reshape(shape)
    return unflatten(flat)


def flat_shapes(config: VGGTConfig) -> dict[str, tuple[int, ...]]:
    """Return flat dotted names -> shapes of a model's parameter tree."""
    from flax.traverse_util import flatten_dict

    from vggtjax.model import parameter_shapes

    return {path: leaf.shape for path, leaf in flatten_dict(parameter_shapes(config), sep=".").items()}


def unflatten(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested tree of flat dotted names."""
    from flax.traverse_util import unflatten_dict

    return unflatten_dict(dict(flat), sep=".")


def _shape_problem(shape: tuple[int, ...], transform: Transform, wanted: tuple[int, ...]) -> str | None:
    try:
        made = transform(np.broadcast_to(np.float32(0), shape)).shape  # a view: costs no memory
    except ValueError as error:
        return f"has shape {list(shape)}, expected {error}"
    return None if made == wanted else f"has shape {list(shape)}, which makes {list(made)}, expected {list(wanted)}"
