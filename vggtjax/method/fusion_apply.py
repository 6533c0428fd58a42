"""A fitted rule of fusion in the pipeline: depth and confidence of a method's result, joined anew."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vggtjax.errors import InputError
from vggtjax.method.fusion import scale_between
from vggtjax.method.fusion_file import fusion_about, load_fusion
from vggtjax.method.fusion_inputs import observe
from vggtjax.method.fusion_rule import FusionParams, fuse
from vggtjax.method.passes import Assembly, Passes
from vggtjax.options import METHODS, find_method

logger = logging.getLogger(__name__)


def fused_anew(
    assembly: Assembly, passes: Passes, fusion: FusionParams, patch_size: int, *, align_scale: bool = False
) -> Assembly:
    """Return an assembly with depth and confidence by a fitted rule; the confidence is the fused precision."""
    scale = None
    if align_scale and passes.second is not None:
        scale = scale_between(passes.first.depth, passes.second.depth, passes.dynamic_mask)  # pyright: ignore
    fused = fuse(fusion, observe(passes, patch_size, scale=scale))
    return assembly._replace(depth=fused.depth, confidence=fused.precision)


def check_fuses(method: str) -> None:
    """Raise InputError for a method that a fusion is no part of."""
    if find_method(method).depth != "fused":
        names = ", ".join(name for name, row in METHODS.items() if row.depth == "fused")
        raise InputError(f"a fusion is given, and method {method!r} does not fuse; expected {names}")


def read_fusion(path: Path, methods: Sequence[str], **settings: Any) -> FusionParams:
    """Return the tree of a file for methods of which one fuses; InputError as `load_fusion`.

    A warning is logged where it was fitted with other settings (`model`, `align_scale`, `mask_pairs`).
    """
    if all(find_method(method).depth != "fused" for method in methods):
        check_fuses(methods[0])
    fusion, about = load_fusion(path), fusion_about(path)
    for name, value in settings.items():
        if name in about and about[name] != value:
            logger.warning("%s was fitted with %s %s, and is used with %s", path, name, about[name], value)
    return fusion


def fusion_digest(fusion: FusionParams | None) -> str | None:
    """Return what tells trees apart in the settings of a result."""
    if fusion is None:
        return None
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(fusion):
        digest.update(np.asarray(leaf, np.float32).tobytes())
    return digest.hexdigest()[:16]
