"""Several methods on one clip: methods with equal passes share one run of them."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

from vggtjax.clips.clip import Clip
from vggtjax.clips.fingerprint import source_setting
from vggtjax.config import MotionConfig
from vggtjax.errors import InputError
from vggtjax.method.assembly import FusionRule, as_tree, assemble, check_fuses
from vggtjax.method.fusion.file import fusion_digest
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.fields import assembled_fields
from vggtjax.pipeline.run import reconstruct, refined
from vggtjax.pipeline.running import Running, check_kinds
from vggtjax.pipeline.steps import Execute
from vggtjax.progress import OnStage, no_stage
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import FieldOfViewWarning, without_mask


def reconstruct_methods(
    model: Model,
    clip: Clip,
    methods: Sequence[str],
    *,
    options: Options = Options(),
    size: int | None = None,
    fusion: FusionRule | None = None,
    on_stage: OnStage | None = None,
    **changes: Any,
) -> dict[str, Reconstruction]:
    """Reconstruct a clip by several methods, each as `reconstruct` does.

    Methods that mine and suppress alike, such as those of `ABLATION`, share one run of the passes.

    Args:
        methods: names of `METHODS`.
        options: settings of all methods; `options.method` is not read.
        fusion: the rule of fusion of the methods that fuse; at least one of them must.
        model, clip, size, on_stage, changes: as for `reconstruct`, whose errors are raised.

    Returns:
        The results by method, in the order of `methods`.
    """
    check_kinds(model=model, options=options)
    options = options.changed(**changes)
    check_fuses(fusion, *methods)
    if options.refine_cameras:
        raise InputError("refine_cameras is for one method; reconstruct with each method by itself")
    results, known = dict[str, Reconstruction](), source_setting(clip.source)
    for group in groups_of_methods(methods, options, model.config.motion):
        shared = next((each for each in group if each.row.needs_second_pass), group[0]).changed(
            refine_mask=False, consistent_depth=False
        )
        running = Running(keep_passes=True, is_part=True, on_stage=on_stage)
        result = reconstruct(model, clip, options=shared, running=running, size=size)
        result = dataclasses.replace(result, settings=result.settings | known)
        for each in group:
            results[each.method] = _as_method(model, result, each, fusion, clip, on_stage or no_stage)
    return {name: results[name] for name in methods}


def groups_of_methods(methods: Sequence[str], options: Options, motion: MotionConfig) -> list[list[Options]]:
    """Return the options of each method, in groups with equal passes."""
    groups: dict[tuple, list[Options]] = {}
    for name in methods:
        each = options.changed(method=name)
        groups.setdefault(tuple(each.passes_settings(motion).items()), []).append(each)
    return list(groups.values())


def _as_method(
    model: Model, result: Reconstruction, options: Options, fusion: FusionRule | None, clip: Clip, on_stage: OnStage
) -> Reconstruction:
    """Return what another method makes of the passes that a result keeps."""
    method, passes = options.row, result.passes
    fusion = fusion if method.depth == "fused" else None
    how = {name: getattr(options, name) for name in ("method", "align_scale")}
    assembly = Execute()("assemble", assemble)(passes, as_tree(fusion), **how)
    settings = result.settings | {"refine_mask": method.refine}
    with warnings.catch_warnings():
        if result.method == options.method:  # the warning about clamped cameras has been given already
            warnings.simplefilter("ignore", FieldOfViewWarning)
        result = dataclasses.replace(
            result,
            **assembled_fields(
                assembly, getattr(passes, method.intrinsics), clip, world_is_first=model.config.row.world_is_first
            ),
            method=options.method,
            settings=settings if fusion is None else settings | {"fusion": fusion_digest(fusion)},
            passes=None,
        )
    result = agree_with_pixels(result, clip.pictures, options, on_stage=on_stage)
    if method.refine and result.has_mask:
        with on_stage("refine mask") as progress:
            result = refined(result, progress)
    return without_mask(result)
