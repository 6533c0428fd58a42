"""A fitted rule of fusion in the pipeline: depth and confidence of a method's result, joined anew."""

from __future__ import annotations

import hashlib
from pathlib import Path

import jax
import numpy as np

from vggtjax.errors import InputError
from vggtjax.fusion import scale_between
from vggtjax.learning.family import FusionParams, fuse
from vggtjax.learning.fusion_file import load_fusion
from vggtjax.learning.observe import observe
from vggtjax.methods import METHODS, find_method
from vggtjax.passes import Assembly, Passes


def refused(
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


def read_fusion(path: Path | None, method: str) -> FusionParams | None:
    """Return the tree of a file for a method that fuses, None for None; InputError as `load_fusion`."""
    if path is None:
        return None
    check_fuses(method)
    return load_fusion(path)


def fusion_digest(fusion: FusionParams | None) -> str | None:
    """Return what tells trees apart in the settings of a result."""
    if fusion is None:
        return None
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(fusion):
        digest.update(np.asarray(leaf, np.float32).tobytes())
    return digest.hexdigest()[:16]
