"""Which published model weights are, and what its files are like."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np

from converters.files import Tensor
from converters.locate import Weights
from vggtjax.config import DA3, VGGTConfig, vggt_1b
from vggtjax.errors import CheckpointError
from vggtjax.storage.json_values import read_json

T = TypeVar("T")

_BACKBONE = re.compile(r"(?:.*\.)?backbone\.pretrained\.(\w+)")
_SHARED = re.compile(r"head\.scratch\.output_conv2_aux\.([0-3])\.2\.(weight|bias)")


def published_config(tensors: Mapping[str, Tensor], weights: Weights) -> VGGTConfig:
    """Return the configuration of a published model: VGGT-1B, or a Depth Anything 3.

    The latter is named by the config.json beside its weights; without it, their width tells. Raises CheckpointError for
    a Depth Anything 3 of another kind, or of a width that was not published.
    """
    own = {match[1]: tensor for name, tensor in tensors.items() if (match := _BACKBONE.fullmatch(name))}
    if not own:
        return vggt_1b()
    expected = f"expected an any-view model: {', '.join(DA3)}"
    if "camera_token" not in own:
        raise CheckpointError(
            f"{weights.name} is a Depth Anything 3 for single pictures (Mono or Metric), without cameras; {expected}"
        )
    values: dict[str, Any] = {}
    with suppress(CheckpointError):  # of another program, or none
        values = read_json(weights.path.parent / "config.json", dict[str, Any], "the file", error=CheckpointError)
    name, width = values.get("model_name"), (0, *own["camera_token"].shape)[-1]
    if isinstance(name, str) and name in DA3:
        return DA3[name]
    for config in DA3.values():
        if config.embed_dim == width:
            return config
    raise CheckpointError(
        f"{weights.name} is a Depth Anything 3 of {width} channels; {expected}, or its own configuration "
        "(--config FILE.json)"
    )


def shared_once(tensors: Mapping[str, T], source: str) -> Mapping[str, T]:
    """Return tensors without copies of the norm that the levels of Depth Anything 3's rays share.

    A file has it once. Raises CheckpointError where the copies of a state dict differ.
    """
    copies = {name: match for name in tensors if (match := _SHARED.fullmatch(name)) and match[1] != "0"}
    for name, match in copies.items():
        first = f"head.scratch.output_conv2_aux.0.2.{match[2]}"
        if first not in tensors or not np.array_equal(np.asarray(tensors[first]), np.asarray(tensors[name])):
            raise CheckpointError(f"{source} has {name} that differs from {first}; expected one norm for all levels")
    return {name: value for name, value in tensors.items() if name not in copies} if copies else tensors
