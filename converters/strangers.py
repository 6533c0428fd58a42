"""Checkpoints of VGGT's relatives, which other networks run: known by what sets them apart, and refused by name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from vggtjax.errors import CheckpointError


class Stranger(NamedTuple):
    """A relative, and what tells its checkpoints from VGGT's: a key or, where all keys are VGGT's, name or content."""

    name: str
    difference: str  # what its network does that VGGT's does not
    key: str = r"(?!)"  # pattern that some key begins with
    source: str = r"(?!)"  # pattern somewhere in the name, in lower case
    sha256: tuple[str, ...] = ()  # of published files


# Read off the projects' public code; that of StreamVGGT loads VGGT's own weights strictly, so the keys are the same.
STRANGERS = (
    Stranger(
        "StreamVGGT",
        "its keys are VGGT's, but its global attention is causal, each frame seeing only those before it",
        source=r"stream[-_]?vggt",
        sha256=("3d3d914d09609fdb485e16947c4885cca0e5ea4e5557598a3b3ffb1cfe0a2f59",),
    ),
    Stranger("STream3R", "its keys are VGGT's, but its global attention is causal", source=r"stream3r"),
    Stranger(
        "PAGE-4D",
        "its aggregator has a network that predicts what moves and masks attention with it",
        r"aggregator\.spatial_mask_head\.",
    ),
    Stranger(
        "VGGT-Omega",
        "its aggregator and heads are others than VGGT's",
        r"aggregator\.inter_frame_blocks\.|dense_head\.|camera_head\.camera_branch\.",
    ),
    Stranger(
        "OmniVGGT",
        "its aggregator takes depth and cameras as inputs",
        r"aggregator\.(depth_placeholder|camera_adapters\.|pose_embeddings\.|depth_patch_embed)",
    ),
    Stranger("Pi3", "it has an encoder and decoders of its own, no first frame", r"(point|conf|camera)_decoder\."),
    Stranger("MapAnything", "it encodes images and geometry by itself", r"(model\.)?(info_sharing\.|scale_token)"),
    Stranger("Depth Anything 3", "it has one plain transformer", r"(model\.)?(da3\.|backbone\.pretrained\.)"),
    Stranger("AnySplat", "it predicts Gaussians", r"encoder\.(aggregator|gaussian_param_head)\."),
    Stranger("HunyuanWorld-Mirror", "it takes priors and predicts Gaussians", r"visual_geometry_transformer\."),
)


def refuse_strangers(source: str, keys: Iterable[str] = (), sha256: Mapping[str, str] | None = None) -> None:
    """Raise CheckpointError if a checkpoint is known to be of a relative of VGGT.

    Args:
        source: name of the weights: a hub id, or that of their file or folder.
        keys: of its tensors.
        sha256: of its files.
    """
    keys = list(keys)
    for stranger in STRANGERS:
        named = re.search(stranger.source, source.lower())
        same = set((sha256 or {}).values()) & set(stranger.sha256)
        if named or same or any(re.match(stranger.key, key) for key in keys):
            raise CheckpointError(
                f"{source} is a checkpoint of {stranger.name}, not of VGGT: {stranger.difference}, which this library "
                "does not run; expected weights of VGGT" + ("; if they are, give them another name" if named else "")
            )
