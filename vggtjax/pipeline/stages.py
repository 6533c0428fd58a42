"""The stages that reconstruct a clip, as a table of jitted functions, and their compilation ahead of the first run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.clips.queries import Queries
from vggtjax.config import Gram, Suppress, VGGTConfig
from vggtjax.method.fusion_inputs import apply_fusion
from vggtjax.method.fusion_rule import FusionParams
from vggtjax.method.mask import mine_mask
from vggtjax.method.passes import Assembly, Cameras, Passes, assemble, first_pass, second_pass, track_from
from vggtjax.network.backbone import encode
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.model import Predictions
from vggtjax.network.precision import Compute
from vggtjax.network.suppression import Suppression
from vggtjax.network.track_head import Tracks
from vggtjax.options import check_mask_pairs, check_smooth_frames, find_method
from vggtjax.storage.programs import Program, keep_type


class Stage(NamedTuple):
    """A program, the arrays that it reads and makes (by name), and its static options."""

    name: str
    reads: tuple[str, ...]
    makes: tuple[str, ...]
    function: Program
    options: dict[str, Any]

    def run(self, arrays: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the stage makes of what it reads, by name."""
        return self.named(self.function(*(arrays[name] for name in self.reads), **self.options))

    def named(self, made: Any) -> dict[str, Any]:
        """Return what the function has returned, by name."""
        return dict(zip(self.makes, made if len(self.makes) > 1 else (made,), strict=True))


class StageMemory(NamedTuple):
    """What a compiled stage needs beside what it reads, by XLA's own analysis, in bytes."""

    temporary: int
    output: int


def _first(params, images, patch_tokens, frame_count, query_points=None, *, compute_dtype, **options):
    clips = ClipBatch(images, patch_tokens, frame_count)
    return first_pass(params, clips, query_points=query_points, compute=Compute(compute_dtype), **options)


def _second(
    params, images, patch_tokens, frame_count, dynamic_mask, first, *, suppress, mask_pairs, compute_dtype, **options
):
    clips = ClipBatch(images, patch_tokens, frame_count)
    options |= {"suppression": Suppression(suppress=suppress, mask_pairs=mask_pairs), "compute": Compute(compute_dtype)}
    return second_pass(params, clips, dynamic_mask, plain=first, **options)


def _tracks(params, images, patch_tokens, query_points, frame, *, config, compute_dtype):
    clips = ClipBatch(images, patch_tokens)
    return track_from(params, clips, query_points, frame, config, compute=Compute(compute_dtype))


def _mine(
    saliency: Float[Array, "B F h w"], patch_tokens: Float[Array, "B F P C"], *, frames: int, **options
) -> Bool[Array, "B F H W"]:
    """Mine the mask of the first `frames` frames; nothing moves in the others."""
    mask = mine_mask(saliency[:, :frames], patch_tokens[:, :frames], **options)
    return jnp.pad(mask, ((0, 0), (0, saliency.shape[1] - frames), (0, 0), (0, 0)))


def _assemble(
    first: Predictions,
    second: Predictions | None,
    saliency,
    dynamic_mask,
    fusion: FusionParams | None = None,
    *,
    frames: int,
    method: str,
    align_scale: bool,
    patch_size: int,
) -> Assembly:
    passes = jax.tree.map(lambda x: x[:, :frames], Passes(first, second, saliency, dynamic_mask))
    made = assemble(passes, method, align_scale=align_scale)
    return made if fusion is None else apply_fusion(made, passes, fusion, patch_size, align_scale=align_scale)


def _unchanged(predictions: Predictions) -> Predictions:
    return predictions


_encode = Program(encode, static=("config", "compute_dtype"))
_first_pass = Program(_first, static=("config", "gram", "motion", "outputs", "compute_dtype"))
_mine_mask = Program(_mine, static=("frames", "size", "clusters", "threshold", "smooth_frames"))
_second_pass = Program(_second, static=("config", "suppress", "outputs", "compute_dtype"))  # one for all mask_pairs
_track_from = Program(_tracks, static=("config", "compute_dtype"))
_same = Program(_unchanged)
assembled = Program(_assemble, static=("frames", "method", "align_scale", "patch_size"))
for _kind in (Predictions, Passes, Cameras, Assembly, Tracks):
    keep_type(_kind)


def stages_of(
    config: VGGTConfig,
    method: str,
    shape: tuple[int, int, int],
    *,
    gram: Gram,
    suppress: Suppress,
    mask_pairs: int,
    align_scale: bool,
    smooth_frames: int,
    compute_dtype: str,
    all_outputs: bool = False,
) -> list[Stage]:
    """Return the stages of a method for clips of this shape (frames, height, width).

    They begin with "params", "images" and "frame_count", which is None where every frame is real, "second", None, and
    "fusion", None for the method's own rule.
    With `all_outputs` the second pass predicts depth even if the method does not read it. Raises InputError for
    settings that are none.
    """
    check_mask_pairs(mask_pairs)
    check_smooth_frames(smooth_frames)
    row = find_method(method)
    frames, *size = shape
    network = {"config": config, "compute_dtype": compute_dtype}
    outputs = ("camera", "depth") if all_outputs else row.second_outputs(align_scale)
    masking = {"suppress": suppress, "mask_pairs": mask_pairs, "outputs": outputs}
    making = {"frames": frames, "method": method, "align_scale": align_scale, "patch_size": config.patch_size}
    mining = {"clusters": row.clusters, "threshold": row.threshold, "smooth_frames": smooth_frames}
    mining |= {"frames": frames, "size": tuple(size)}
    seen = ("params", "images", "patch_tokens", "frame_count")
    stages = [
        Stage("image features", ("params", "images"), ("patch_tokens",), _encode, network),
        Stage("first pass", seen, ("first", "saliency"), _first_pass, network | {"gram": gram}),
        Stage("dynamic mask", ("saliency", "patch_tokens"), ("dynamic_mask",), _mine_mask, mining),
        Stage("second pass", (*seen, "dynamic_mask", "first"), ("second",), _second_pass, network | masking),
        Stage("assemble", ("first", "second", "saliency", "dynamic_mask", "fusion"), ("assembly",), assembled, making),
    ]
    return [stage for stage in stages if stage.name != "second pass" or row.needs_second_pass]


def with_masks(stages: list[Stage], moving: bool) -> list[Stage]:
    """Return the stages with masks that are given; if nothing moves, the second pass is the first."""
    stages = [stage for stage in stages if stage.name != "dynamic mask"]
    if moving:
        return stages
    same = Stage("second pass", ("first",), ("second",), _same, {})
    return [same if stage.name == same.name else stage for stage in stages]


def with_tracks(stages: list[Stage], queries: Queries, arrays: dict[str, Any]) -> list[Stage]:
    """Return the stages with tracks: of the first frame's points by the first pass, then of every other frame's.

    The points are put into `arrays`.
    """
    stages = list(stages)
    network = {name: stages[0].options[name] for name in ("config", "compute_dtype")}
    for frame in np.unique(queries.frames).tolist():
        points = jnp.asarray(queries.points[queries.frames == frame])[None]
        if frame == 0:
            arrays["query_points"] = points
            index = next(i for i, stage in enumerate(stages) if stage.name == "first pass")
            stages[index] = stages[index]._replace(reads=(*stages[index].reads, "query_points"))
        else:
            arrays |= {f"points {frame}": points, f"frame {frame}": jnp.int32(frame)}
            reads = ("params", "images", "patch_tokens", f"points {frame}", f"frame {frame}")
            stages.append(Stage("tracks", reads, (f"tracks {frame}",), _track_from, network))
    return stages


def compile_stages(stages: list[Stage], arrays: dict[str, Any]) -> dict[str, StageMemory]:
    """Compile every stage for the shapes that it will see; the calls that follow find the result in jit's cache."""
    shapes, needs = dict(arrays), {}
    for stage in stages:
        compiled, made = stage.function.compile(*(shapes[name] for name in stage.reads), **stage.options)
        memory = compiled.memory_analysis()
        if memory is not None:  # not every platform tells
            needs[stage.name] = StageMemory(memory.temp_size_in_bytes, memory.output_size_in_bytes)
        shapes |= stage.named(made)
    return needs
