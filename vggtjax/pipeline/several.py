"""Several methods on one clip: those that mine and suppress alike share one run of the passes."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from contextlib import nullcontext

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip
from vggtjax.method.fusion_file import check_fuses, fusion_digest
from vggtjax.method.fusion_rule import FusionParams
from vggtjax.options import find_method
from vggtjax.pipeline.run import assembled_fields, reconstruct, refined
from vggtjax.pipeline.stages import assembled
from vggtjax.progress import OnStage
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import FieldOfViewWarning


def reconstruct_methods(
    model: Model,
    clip: Clip,
    methods: Sequence[str],
    *,
    size: int | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    smooth_frames: int = 1,
    fusion: FusionParams | None = None,
    compute_dtype: str = "float32",
    on_stage: OnStage | None = None,
) -> dict[str, Reconstruction]:
    """Reconstruct a clip by several methods, each as `reconstruct` does; what they have in common is computed once.

    Methods that mine and suppress alike, which those of `LADDER` do, share one run of the passes.

    Args:
        methods: names of `METHODS`.
        fusion: how those that fuse do it; one of them must.
        model, clip, size, mask_pairs, align_scale, smooth_frames, compute_dtype, on_stage: as for `reconstruct`.

    Returns:
        The results by method, in the order of `methods`.

    Raises:
        What `reconstruct` raises.
    """
    if fusion is not None:
        check_fuses(*methods)
    results: dict[str, Reconstruction] = {}
    for names in groups_of_methods(methods):
        made = reconstruct(
            model,
            clip,
            method=next((name for name in names if find_method(name).needs_second_pass), names[0]),
            size=size,
            mask_pairs=mask_pairs,
            align_scale=align_scale,
            smooth_frames=smooth_frames,
            refine_mask=False,
            compute_dtype=compute_dtype,
            keep_passes=True,
            on_stage=on_stage,
        )
        for name in names:
            results[name] = _as_method(
                made, name, align_scale, model.config.patch_size, fusion, on_stage or (lambda name: nullcontext())
            )
    return {name: results[name] for name in methods}


def groups_of_methods(methods: Sequence[str]) -> list[list[str]]:
    """Return methods in groups that mine and suppress alike: the passes are run once for each."""
    alike: dict[tuple, list[str]] = {}
    for name in methods:
        row = find_method(name)
        alike.setdefault((row.gram, row.suppress, row.clusters, row.threshold), []).append(name)
    return list(alike.values())


def _as_method(
    made: Reconstruction,
    method: str,
    align_scale: bool,
    patch_size: int,
    fusion: FusionParams | None,
    on_stage: OnStage,
) -> Reconstruction:
    """Return what another method makes of the passes that a result keeps."""
    row, passes = find_method(method), made.passes
    making = {"frames": len(made.depth), "method": method, "align_scale": align_scale, "patch_size": patch_size}
    fusion = fusion if row.depth == "fused" else None
    with warnings.catch_warnings():
        if made.method == method:  # it has said already which cameras were clamped
            warnings.simplefilter("ignore", FieldOfViewWarning)
        result = dataclasses.replace(
            made,
            **assembled_fields(assembled(*passes, fusion, **making), getattr(passes, row.intrinsics)),
            method=method,
            settings=made.settings
            | {"refine_mask": row.refine}
            | ({} if fusion is None else {"fusion": fusion_digest(fusion)}),
            passes=None,
        )
    if row.refine:
        with on_stage("refine mask") as progress:
            result = refined(result, progress)
    return result
