"""What trainers make of names: shared prefixes, adapters, heads that were not trained."""

from __future__ import annotations

import dataclasses
import logging
import re
from collections import Counter
from collections.abc import Collection, Mapping
from typing import TypeVar

from vggtjax.config import VGGTConfig
from vggtjax.errors import CheckpointError

T = TypeVar("T")

_ADAPTER = re.compile(r"(?:^|\.)(?:lora_|hada_|lokr_|ia3_|oft_|base_layer\.)")
_COUNTED = ("n_averaged",)  # of torch's AveragedModel, beside its module
_MOST_LETTERS = 100  # of a prefix
SOURCES = {  # the modules of heads, by family
    "vggt": {"camera": "camera_head", "depth": "depth_head", "points": "point_head", "tracks": "track_head"},
    "da3": {"camera": "cam_dec", "depth": "head", "rays": "head"},
}
USUAL = {"vggt": "", "da3": "model."}  # prefix of published files

logger = logging.getLogger(__name__)


def own_names(tensors: Mapping[str, T], modules: Collection[str], source: str, usual: str = "") -> Mapping[str, T]:
    """Return tensors by the network's own names, without a prefix that all of them share, such as `module.`.

    The prefix is said, unless it is the `usual` one.
    `modules` are the first words of its names. Raises CheckpointError for an adapter that is not merged into its
    weights, and for weights that are there twice, such as beside their moving average.
    """
    if adapters := [name for name in tensors if _ADAPTER.search(name)]:
        raise CheckpointError(
            f"{source} holds an adapter beside its weights ({adapters[0]}, {len(adapters)} keys); merge the adapter "
            "first, such as by merge_and_unload() of peft, and save the merged state dict"
        )
    found = Counter(prefix for name in tensors if (prefix := _prefix(name, modules)) is not None)
    copies = [prefix for prefix, count in found.items() if 2 * count > max(found.values())]
    if len(copies) > 1:
        names = " and ".join(repr(prefix) if prefix else "no prefix" for prefix in sorted(copies))
        raise CheckpointError(
            f"{source} holds weights of the network twice or more, under {names}; save one of them alone"
        )
    (prefix,) = copies or ("",)
    if not prefix:
        return tensors
    if prefix != usual:
        logger.warning("the keys of %s begin with %s, which is left out", source, prefix)
    own = {name: value for name, value in tensors.items() if name not in _COUNTED}
    return {name.removeprefix(prefix): value for name, value in own.items()}


def own_heads(tensors: Collection[str], config: VGGTConfig, source: str) -> VGGTConfig:
    """Return the configuration with those heads alone that the weights have, and say so; as it is without any."""
    modules = {name.partition(".")[0] for name in tensors}
    heads = tuple(head for head in config.heads if SOURCES[config.family][head] in modules)
    if not heads or heads == config.heads:
        return config
    lacking = ", ".join(head for head in config.heads if head not in heads)
    logger.warning("%s has the heads %s, and not %s", source, ", ".join(heads), lacking)
    return dataclasses.replace(config, heads=heads)


def _prefix(name: str, modules: Collection[str]) -> str | None:
    """Return what stands before the first of the modules in a name, None where there is none."""
    words = name.split(".")
    place = next((place for place, word in enumerate(words) if word in modules), None)
    prefix = None if place is None else "".join(f"{word}." for word in words[:place])
    return prefix if prefix is None or len(prefix) <= _MOST_LETTERS else None
