"""Checkpoints of networks related to VGGT: recognised by keys, names or sha256, and refused."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from vggtjax.errors import CheckpointError


class Stranger(NamedTuple):
    """A related network, and how to recognise its checkpoints: by a key or, if all keys are VGGT's, name or sha256."""

    name: str
    difference: str  # of its network from VGGT's
    key: str = r"(?!)"  # pattern at the start of a key
    source: str = r"(?!)"  # pattern in the name, in lower case
    sha256: tuple[str, ...] = ()  # of published files


# From the projects' public code. StreamVGGT's code loads VGGT's weights strictly, so the keys are equal.
FOREIGN = (
    Stranger(
        "StreamVGGT",
        "its keys are VGGT's, but its global attention is causal: a frame reads earlier frames only",
        source=r"stream[-_]?vggt",
        sha256=("3d3d914d09609fdb485e16947c4885cca0e5ea4e5557598a3b3ffb1cfe0a2f59",),
    ),
    Stranger("STream3R", "its keys are VGGT's, but its global attention is causal", source=r"stream3r"),
    Stranger("PAGE-4D", "its aggregator masks attention by predicted motion", r"aggregator\.spatial_mask_head\."),
    Stranger(
        "VGGT-Omega",
        "its aggregator and heads differ from VGGT's",
        r"aggregator\.inter_frame_blocks\.|dense_head\.|camera_head\.camera_branch\.",
    ),
    Stranger(
        "OmniVGGT",
        "its aggregator takes depth and cameras as inputs",
        r"aggregator\.(depth_placeholder|camera_adapters\.|pose_embeddings\.|depth_patch_embed)",
    ),
    Stranger("Pi3", "it has other decoders, and no reference frame", r"(point|conf|camera)_decoder\."),
    Stranger("MapAnything", "it has another encoder of images and geometry", r"(model\.)?(info_sharing\.|scale_token)"),
    Stranger(
        "Depth Anything 3 Nested",
        "it is two models, any-view and metric; the any-view one alone is published as DA3-GIANT-1.1",
        r"(model\.)?da3(_metric)?\.",
    ),
    Stranger("AnySplat", "it predicts Gaussians", r"encoder\.(aggregator|gaussian_param_head)\."),
    Stranger("HunyuanWorld-Mirror", "it takes priors and predicts Gaussians", r"visual_geometry_transformer\."),
)


def refuse_foreign(source: str, keys: Iterable[str] = (), sha256: Mapping[str, str] | None = None) -> None:
    """Raise CheckpointError for a checkpoint of a network related to VGGT.

    `source` is the name of the weights, a hub id or the name of their file or folder; `keys` are of the tensors,
    `sha256` of the files.
    """
    keys = list(keys)
    for stranger in FOREIGN:
        has_its_name = re.search(stranger.source, source.lower())
        has_its_content = set((sha256 or {}).values()) & set(stranger.sha256)
        if has_its_name or has_its_content or any(re.match(stranger.key, key) for key in keys):
            raise CheckpointError(
                f"{source} is a checkpoint of {stranger.name}, not of VGGT: {stranger.difference}; expected weights "
                "of VGGT or Depth Anything 3" + ("; rename them if they are weights of VGGT" if has_its_name else "")
            )
