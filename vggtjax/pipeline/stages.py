"""The data flow of a reconstruction: one function, to run or to compile ahead."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from vggtjax.cameras import Cameras
from vggtjax.config import VGGTConfig
from vggtjax.method.fusion_family import FusionParams
from vggtjax.method.fusion_inputs import apply_fusion
from vggtjax.method.mask import mine_mask
from vggtjax.method.passes import Assembly, Passes, assemble, first_pass, second_pass, track_from
from vggtjax.network.backbone import encode
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.frames import BY_FRAME, WHOLE, Frames
from vggtjax.network.layers import Params
from vggtjax.network.model import Predictions
from vggtjax.network.precision import Compute
from vggtjax.network.quantised import Quantised
from vggtjax.network.suppression import Suppression
from vggtjax.network.track_head import Tracks
from vggtjax.options import Options
from vggtjax.progress import OnStage, no_stage
from vggtjax.storage.programs import Program, keep_type

_COLLECTIVE = re.compile(
    r" (all-gather|all-reduce|all-to-all|ragged-all-to-all|reduce-scatter|collective-\w+|send|recv)(?:-start)?\("
)
_DIGITS = 4  # significant binary digits of padded lengths: no clip gets longer by more than an eighth


def padded_frames(frames: int, offsets: tuple[int, ...]) -> int:
    """Return the length rounded up to four significant binary digits: 1 to 16, 18, 20, ... 32, 36, ...

    Clips of similar length then share compiled programs. A clip is not padded if one of its frames has no other frame
    at any of the `offsets` of the motion cues: padding would give that frame another one to be compared with.
    """
    if not all(any(0 <= frame + offset < frames for offset in offsets) for frame in range(frames)):
        return frames
    step = 1 << max(frames.bit_length() - _DIGITS, 0)
    return -(-frames // step) * step


def _image_features(params, images, *, frames: Frames, **options):
    return frames.on_devices(partial(encode, **options), WHOLE, BY_FRAME)(params, images)


def _first(params, clips, query_points=None, *, compute_dtype, attention, frames: Frames, **options):
    def run(params, clips, query_points):
        compute = Compute(compute_dtype, attention=attention, frames=frames)
        return first_pass(params, clips, query_points=query_points, compute=compute, **options)

    return frames.on_devices(run, WHOLE, _CLIPS, WHOLE)(params, clips, query_points)


def _second(
    params, clips, dynamic_mask, first, *, suppress, mask_pairs, compute_dtype, attention, frames: Frames, **options
):
    def run(params, clips, dynamic_mask, first, mask_pairs):
        suppression = Suppression(suppress=suppress, mask_pairs=mask_pairs)
        masking = {
            "plain": first,
            "suppression": suppression,
            "compute": Compute(compute_dtype, attention=attention, frames=frames),
        }
        return second_pass(params, clips, dynamic_mask, **masking, **options)

    located = frames.on_devices(run, WHOLE, _CLIPS, BY_FRAME, BY_FRAME, WHOLE)
    return located(params, clips, dynamic_mask, first, mask_pairs)


def _track(params, clips, query_points, frame, *, config, compute_dtype, attention, frames: Frames):
    track = partial(track_from, config=config, compute=Compute(compute_dtype, attention=attention, frames=frames))
    return frames.on_devices(track, WHOLE, _CLIPS, WHOLE, WHOLE)(params, clips, query_points, frame)


def _mine(
    saliency: Float[Array, "B F h w"], patch_tokens: Float[Array, "B F P C"], *, frames: Frames, **options
) -> Bool[Array, "B F H W"]:
    """Mine the mask of the first `frames.count` frames; padded frames get an empty mask."""
    if frames.mesh is not None:
        mine = partial(mine_mask, frames=frames, **options)
        return frames.on_devices(mine, BY_FRAME, BY_FRAME)(saliency, patch_tokens)
    mask = mine_mask(saliency[:, : frames.count], patch_tokens[:, : frames.count], **options)
    return jnp.pad(mask, ((0, 0), (0, saliency.shape[1] - mask.shape[1]), (0, 0), (0, 0)))


def _assemble(
    passes: Passes, fusion: FusionParams | None, *, frames: Frames, method: str, align_scale: bool, patch_size: int
) -> Assembly:
    """Assemble the first `frames.count` frames; on several devices the padded ones follow."""

    def run(passes, fusion):
        changes = {"align_scale": align_scale, "frames": frames}
        assembly = assemble(passes, method, **changes)
        return assembly if fusion is None else apply_fusion(assembly, passes, fusion, patch_size, **changes)

    if frames.mesh is None:
        passes = jax.tree.map(lambda x: x[:, : frames.count], passes)
    return frames.on_devices(run, BY_FRAME, WHOLE)(passes, fusion)


_CLIPS = ClipBatch(BY_FRAME, BY_FRAME, WHOLE)  # type: ignore[arg-type]
_encode = Program(_image_features, static=("config", "compute_dtype", "frames"))
_first_pass = Program(_first, static=("config", "gram", "compute_dtype", "attention", "frames"))
_mine_mask = Program(_mine, static=("frames", "size", "clusters", "threshold", "smooth_frames"))
_SECOND_STATIC = ("config", "suppress", "outputs", "compute_dtype", "attention", "frames")  # mask_pairs is traced
_second_pass = Program(_second, static=_SECOND_STATIC)
_track_from = Program(_track, static=("config", "compute_dtype", "attention", "frames"))
_assembled = Program(_assemble, static=("frames", "method", "align_scale", "patch_size"))
for _kind in (ClipBatch, Predictions, Passes, Cameras, Assembly, Tracks, Quantised):
    keep_type(_kind)


class StageMemory(NamedTuple):
    """Memory of a compiled stage on each device beside its inputs, by XLA's own analysis, in bytes."""

    temporary: int
    output: int
    collectives: Mapping[str, int] = MappingProxyType({})  # communications between devices in the program, by kind


class Execute:
    """Runs each program as a stage of its own."""

    def __init__(self, on_stage: OnStage | None = None) -> None:
        self._on_stage = on_stage or no_stage

    def __call__(self, stage: str, program: Program, *arguments: Any, **options: Any) -> Any:
        """Return the outputs of the program, when they are computed."""
        with self._on_stage(stage):
            return jax.block_until_ready(program(*arguments, **options))


def inline(stage: str, program: Program, *arguments: Any, **options: Any) -> Any:
    """Compute the outputs of the program as a part of the caller's own program."""
    del stage
    return program.function(*arguments, **options)


def count_collectives(program: str) -> dict[str, int]:
    """Return the number of communications between devices in the text of a compiled program, by kind."""
    return dict(Counter(_COLLECTIVE.findall(program)))


class Compile:
    """Compiles each program for the shapes of its arguments; later calls with such arguments find it compiled.

    Each program is a stage of its own, such as "compile first pass".
    """

    def __init__(self, on_stage: OnStage | None = None) -> None:
        self._on_stage = on_stage or no_stage
        self.memory: dict[str, StageMemory] = {}

    def __call__(self, stage: str, program: Program, *arguments: Any, **options: Any) -> Any:
        """Return the shapes of the program's outputs."""
        with self._on_stage(f"compile {stage}"):
            compiled, outputs = program.compile(*arguments, **options)
        shared = options["frames"].mesh is not None
        collectives = count_collectives(compiled.as_text() or "") if shared else {}
        memory = compiled.memory_analysis()
        if memory is not None:  # some platforms do not tell
            self.memory[stage] = StageMemory(memory.temp_size_in_bytes, memory.output_size_in_bytes, collectives)
        return outputs


@dataclass(frozen=True)
class Stages:
    """The stages for clips of one shape, which may be padded beyond `frames`.

    Each stage reads only the options that it needs: changing an option recompiles only the stages that read it.
    """

    config: VGGTConfig
    options: Options
    frames: int
    size: tuple[int, int]  # height and width in pixels
    run: Callable[..., Any] = field(default_factory=Execute)  # Execute, Compile or inline
    mesh: Mesh | None = None  # of the devices that share the frames
    padded: int | None = None  # frames with those of `ClipInputs.frame_count`, without those that make shares equal

    @property
    def _network(self) -> dict[str, Any]:
        frames = Frames(self.mesh, None if self.mesh is None else self.padded or self.frames)
        return {"config": self.config, "compute_dtype": self.options.compute_dtype, "frames": frames}

    @property
    def _real(self) -> Frames:
        return Frames(self.mesh, self.frames)

    @property
    def _passes(self) -> dict[str, Any]:
        return self._network | {"attention": self.options.attention}

    def image_features(self, params: Params, images: Float[Array, "B F H W 3"]) -> Float[Array, "B F P C"]:
        return self.run("image features", _encode, params, images, **self._network)

    def first_pass(
        self,
        params: Params,
        clips: ClipBatch,
        query_points: Float[Array, "B Q 2"] | None = None,
    ) -> tuple[Predictions, Float[Array, "B F h w"]]:
        """Return what the plain pass predicts, and the motion saliency."""
        points = () if query_points is None else (query_points,)
        return self.run("first pass", _first_pass, params, clips, *points, gram=self.options.row.gram, **self._passes)

    def dynamic_mask(
        self, saliency: Float[Array, "B F h w"], patch_tokens: Float[Array, "B F P C"]
    ) -> Bool[Array, "B F H W"]:
        method = self.options.row
        options = {"clusters": method.clusters, "threshold": method.threshold}
        options |= {"smooth_frames": self.options.smooth_frames, "frames": self._real, "size": self.size}
        return self.run("dynamic mask", _mine_mask, saliency, patch_tokens, **options)

    def second_pass(
        self,
        params: Params,
        clips: ClipBatch,
        dynamic_mask: Bool[Array, "B F H W"],
        first: Predictions,
        *,
        all_outputs: bool = False,
    ) -> Predictions:
        """Return what the mask-aware pass predicts; depth only if the method needs it, or with `all_outputs`."""
        method = self.options.row
        outputs = ("camera", "depth") if all_outputs else method.second_outputs(self.options.align_scale)
        options = {"suppress": method.suppress, "mask_pairs": self.options.mask_pairs, "outputs": outputs}
        return self.run("second pass", _second_pass, params, clips, dynamic_mask, first, **self._passes, **options)

    def assemble(self, passes: Passes, fusion: FusionParams | None = None) -> Assembly:
        """Return the method's depth, confidence and cameras of the real frames, fused by `fusion` if given."""
        options = {"method": self.options.method, "align_scale": self.options.align_scale}
        options |= {"frames": self._real, "patch_size": self.config.patch_size}
        return self.run("assemble", _assembled, passes, fusion, **options)

    def tracks(
        self, params: Params, clips: ClipBatch, query_points: Float[Array, "B Q 2"], frame: Int[np.ndarray, ""]
    ) -> Tracks:
        """Return the tracks of points of a later frame."""
        return self.run("tracks", _track_from, params, clips, query_points, frame, **self._passes)


class ClipInputs(NamedTuple):
    """The arrays of a batch of clips, or their shapes."""

    images: Float[Array, "B F H W 3"]  # RGB in [0, 1]
    frame_count: Int[Array, " B"] | None = None  # real frames; None: all
    dynamic_mask: Bool[Array, "B F H W"] | None = None  # None: mined
    moves: bool = True  # False: no pixel of the given mask is dynamic
    query_points: Mapping[int, Float[Array, "B Q 2"]] = MappingProxyType({})  # points to track, by frame


class Outputs(NamedTuple):
    """What the stages compute of a batch of clips."""

    passes: Passes
    assembly: Assembly
    tracks: dict[int, Tracks]  # by the frame of their query points


def run_stages(
    stages: Stages,
    params: Params,
    inputs: ClipInputs,
    *,
    fusion: FusionParams | None = None,
    all_outputs: bool = False,
) -> Outputs:
    """Reconstruct clips: image features, first pass, dynamic mask, second pass, assembly, tracks.

    Args:
        stages: the stages for these clips; `stages.run` decides whether they are run or compiled.
        params: the model's parameter tree.
        inputs: the clips, and optionally their masks and points to track.
        fusion: a fitted rule of fusion; the method's own rule if None.
        all_outputs: run the second pass with depth even if the method does not need it.
    """
    points = dict(inputs.query_points)
    patch_tokens = stages.image_features(params, inputs.images)
    clips = ClipBatch(inputs.images, patch_tokens, inputs.frame_count)
    first, saliency = stages.first_pass(params, clips, points.pop(0, None))
    mask = inputs.dynamic_mask
    if mask is None:
        mask = stages.dynamic_mask(saliency, patch_tokens)
    second = first if stages.options.row.needs_second_pass else None
    if second is not None and inputs.moves:
        second = stages.second_pass(params, clips, mask, first, all_outputs=all_outputs)
    passes = Passes(first, second, saliency, mask)
    assembly = stages.assemble(passes, fusion)
    tracks = {
        frame: stages.tracks(params, clips, frame_points, np.asarray(frame, np.int32))
        for frame, frame_points in points.items()
    }
    if 0 in inputs.query_points:
        tracks[0] = Tracks(first.tracks, first.track_visibility, first.track_confidence)  # type: ignore[arg-type]
    return Outputs(passes, assembly, tracks)
