"""The data flow of a reconstruction: one function, to run or to compile ahead."""

from __future__ import annotations

import dataclasses
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
from vggtjax.clips.still import same_picture
from vggtjax.config import VGGTConfig
from vggtjax.method.fusion_family import FusionParams
from vggtjax.method.fusion_inputs import apply_fusion
from vggtjax.method.matched_mask import Mined
from vggtjax.method.matches import Matches
from vggtjax.method.motion import FEWEST_FRAMES
from vggtjax.method.passes import (
    Assembly,
    Passes,
    assemble,
    either_pass,
    first_pass,
    mine,
    only,
    second_pass,
    track_from,
    with_adjusted_cameras,
)
from vggtjax.method.witnesses import Seen
from vggtjax.network.backbone import encode
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.frames import BY_FRAME, WHOLE, Frames
from vggtjax.network.layers import Params
from vggtjax.network.model import Predictions
from vggtjax.network.precision import Compute
from vggtjax.network.quantised import Quantised
from vggtjax.network.suppression import Suppression
from vggtjax.network.track_head import Tracks
from vggtjax.options import CamerasFrom, Options
from vggtjax.pipeline.stage_runners import Execute, inline
from vggtjax.storage.programs import Program, keep_type

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


def _first(params, clips, query_points=None, *, compute: Compute, **options):
    def run(params, clips, query_points):
        return first_pass(params, clips, query_points=query_points, compute=compute, **options)

    return compute.frames.on_devices(run, WHOLE, _CLIPS, WHOLE)(params, clips, query_points)


def _second(params, clips, dynamic_mask, first, *, suppress, mask_pairs, compute: Compute, **options):
    def run(params, clips, dynamic_mask, first, mask_pairs):
        masking = {"suppression": Suppression(suppress=suppress, mask_pairs=mask_pairs), "compute": compute}
        return second_pass(params, clips, dynamic_mask, plain=first, **masking, **options)

    located = compute.frames.on_devices(run, WHOLE, _CLIPS, BY_FRAME, BY_FRAME, WHOLE)
    return located(params, clips, dynamic_mask, first, mask_pairs)


def _either(params, clips, dynamic_mask, is_first, *, suppress, mask_pairs, **options):
    suppression = Suppression(suppress=suppress, mask_pairs=mask_pairs)
    return either_pass(params, clips, dynamic_mask, is_first, suppression=suppression, **options)


def _track(params, clips, query_points, frame, *, config, compute: Compute):
    track = partial(track_from, config=config, compute=compute)
    return compute.frames.on_devices(track, WHOLE, _CLIPS, WHOLE, WHOLE)(params, clips, query_points, frame)


def _mine(seen: Seen, first: Predictions | None, clips: ClipBatch, *, frames: Frames, **options) -> Mined:
    """Mine the mask of the first `frames.count` frames; padded frames get an empty mask."""
    if frames.mesh is not None:
        mine_here = partial(mine, frames=frames, **options)
        return frames.on_devices(mine_here, BY_FRAME, BY_FRAME, BY_FRAME)(seen, first, clips)
    added = 0 if frames.count is None else clips.images.shape[1] - frames.count
    mined = mine(*jax.tree.map(lambda x: x[:, : frames.count], (seen, first, clips)), **options)
    return jax.tree.map(lambda x: jnp.pad(x, ((0, 0), (0, added), *((0, 0),) * (x.ndim - 2))), mined)


def _assemble(
    passes: Passes,
    fusion: FusionParams | None,
    *,
    frames: Frames,
    patch_size: int,
    cameras: CamerasFrom,
    **changes: Any,
) -> Assembly:
    """Assemble the first `frames.count` frames; on several devices the padded ones follow."""

    def run(passes, fusion):
        assembly = assemble(passes, frames=frames, **changes)
        if fusion is not None:
            scaling = {"align_scale": changes["align_scale"], "frames": frames}
            assembly = apply_fusion(assembly, passes, fusion, patch_size, **scaling)
        return assembly if cameras == "predicted" else with_adjusted_cameras(assembly, passes, frames)

    if frames.mesh is None:
        passes = jax.tree.map(lambda x: x[:, : frames.count], passes)
    return frames.on_devices(run, BY_FRAME, WHOLE)(passes, fusion)


def _still(images: Float[Array, "B S H W 3"]) -> Bool[Array, " B"]:
    """Return the clips whose frames are all one picture."""
    return same_picture(images[:, 1:], images[:, :1]).all(axis=1)


_FIRST_OUTPUTS = ("camera", "depth")  # of the first pass
_CLIPS = ClipBatch(BY_FRAME, BY_FRAME, WHOLE)  # type: ignore[arg-type]
_encode = Program(_image_features, static=("config", "compute_dtype", "frames"))
_first_pass = Program(_first, static=("config", "gram", "witness", "compute"))
_mine_mask = Program(_mine, static=("frames", "clusters", "threshold", "smooth_frames"))
_SECOND_STATIC = ("config", "suppress", "outputs", "compute")  # mask_pairs is traced
_second_pass = Program(_second, static=_SECOND_STATIC)
_either_pass = Program(_either, static=(*_SECOND_STATIC, "gram", "witness"))
_track_from = Program(_track, static=("config", "compute"))
_assembled = Program(_assemble, static=("frames", "patch_size", "method", "align_scale", "cameras"))
for _kind in (ClipBatch, Predictions, Passes, Seen, Matches, Mined, Cameras, Assembly, Tracks, Quantised):
    keep_type(_kind)


@dataclass(frozen=True)
class Stages:
    """The stages for clips of one shape, which may be padded beyond `frames`.

    Each stage reads only the options that it needs: changing an option recompiles only the stages that read it. The
    values of the method, the model and the platform take the place of options that are None.
    """

    config: VGGTConfig
    options: Options
    frames: int
    size: tuple[int, int]  # height and width in pixels
    run: Callable[..., Any] = field(default_factory=Execute)  # Execute, Compile or inline
    mesh: Mesh | None = None  # of the devices that share the frames
    padded: int | None = None  # frames with those of `ClipInputs.frame_count`, without those that make shares equal
    on_accelerator: bool | None = None  # whether the network will be computed on one; whether jax has one if None

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", self.options.resolved(self.config.motion, self.on_accelerator))

    @property
    def _passes(self) -> dict[str, Any]:
        frames = Frames(self.mesh, None if self.mesh is None else self.padded or self.frames)
        return {"config": self.config, "compute": Compute.of(self.options, frames, self.on_accelerator)}

    @property
    def _real(self) -> Frames:
        return Frames(self.mesh, self.frames)

    def image_features(self, params: Params, images: Float[Array, "B F H W 3"]) -> Float[Array, "B F P C"]:
        compute: Compute = self._passes["compute"]
        options = {"config": self.config, "compute_dtype": compute.compute_dtype, "frames": compute.frames}
        return self.run("image features", _encode, params, images, **options)

    @property
    def _either(self) -> dict[str, Any]:
        return self._passes | self._mining | {"suppress": self.options.row.suppress}

    @property
    def _mining(self) -> dict[str, Any]:
        return {"gram": self.options.row.gram, "witness": self.options.witness}

    def _shared(self, outputs: tuple[str, ...]) -> bool:
        """Return whether one program serves both passes, where the second pass has these outputs."""
        return self.mesh is None and self.run is not inline and outputs == _FIRST_OUTPUTS

    def _second_outputs(self, all_outputs: bool) -> tuple[str, ...]:
        return _FIRST_OUTPUTS if all_outputs else self.options.row.second_outputs(self.options.align_scale)

    def first_pass(
        self,
        params: Params,
        clips: ClipBatch,
        query_points: Float[Array, "B Q 2"] | None = None,
        *,
        second_follows: bool = False,
        all_outputs: bool = False,
    ) -> tuple[Predictions, Seen]:
        """Return what the plain pass predicts, and what it sees of motion.

        If `second_pass` follows with these `all_outputs`, both are one program wherever they can be.
        """
        if second_follows and query_points is None and self._shared(self._second_outputs(all_outputs)):
            nothing = np.zeros(clips.images.shape[:4], bool)
            none = {"mask_pairs": 0, "outputs": _FIRST_OUTPUTS}
            return self.run("first pass", _either_pass, params, clips, nothing, np.True_, **self._either, **none)
        points = () if query_points is None else (query_points,)
        return self.run("first pass", _first_pass, params, clips, *points, **self._mining, **self._passes)

    def dynamic_mask(self, seen: Seen, first: Predictions, clips: ClipBatch) -> Mined:
        """Return the dynamic pixels, and what matches say, if any were asked for."""
        method = self.options.row
        options = {"clusters": method.clusters, "threshold": method.threshold}
        options |= {"smooth_frames": self.options.smooth_frames, "frames": self._real}
        if method.mask == "gram":
            seen = Seen(seen.saliency)
        read = None if seen.matches is None else only(first, _FIRST_OUTPUTS)
        return self.run("dynamic mask", _mine_mask, seen, read, clips._replace(frame_count=None), **options)

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
        outputs = self._second_outputs(all_outputs)
        options = {"mask_pairs": self.options.mask_pairs, "outputs": outputs}
        if not self._shared(outputs):
            options |= self._passes | {"suppress": self.options.row.suppress}
            return self.run("second pass", _second_pass, params, clips, dynamic_mask, first, **options)
        unchanged = only(first, outputs)
        if unchanged is not None and isinstance(dynamic_mask, jax.Array) and not np.asarray(dynamic_mask).any():
            return unchanged
        arguments = (params, clips, dynamic_mask, np.False_)
        return self.run("second pass", _either_pass, *arguments, **self._either, **options)[0]

    def assemble(self, passes: Passes, fusion: FusionParams | None = None) -> Assembly:
        """Return the method's depth, confidence and cameras of the real frames, fused by `fusion` if given."""
        options = {name: getattr(self.options, name) for name in ("method", "align_scale", "cameras")}
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
    if inputs.dynamic_mask is not None or stages.frames < FEWEST_FRAMES:  # nobody would read the matches
        stages = dataclasses.replace(stages, options=stages.options.changed(mask="gram"))
    if stages.frames == 1:
        stages = dataclasses.replace(stages, options=stages.options.changed(cameras="predicted"))
    points = dict(inputs.query_points)
    patch_tokens = stages.image_features(params, inputs.images)
    clips = ClipBatch(inputs.images, patch_tokens, inputs.frame_count)
    runs_second = stages.options.row.needs_second_pass and inputs.moves
    plans = {"second_follows": runs_second, "all_outputs": all_outputs}
    first, seen = stages.first_pass(params, clips, points.pop(0, None), **plans)
    mask = inputs.dynamic_mask
    mined = stages.dynamic_mask(seen, first, clips) if mask is None else Mined(mask)
    if mask is None:
        mask = mined.dynamic_mask
        if stages.run is inline:  # else whoever calls this has looked at the frames
            mask = mask & ~_still(inputs.images[:, : stages.frames])[:, None, None, None]
    second = first if stages.options.row.needs_second_pass else None
    if runs_second:
        second = stages.second_pass(params, clips, mask, first, all_outputs=all_outputs)
    matches = seen.matches if stages.options.cameras == "adjusted" else None
    passes = Passes(first, second, seen.saliency, mask, mined.motion, mined.is_matched, matches)
    assembly = stages.assemble(passes, fusion)
    tracks = {
        frame: stages.tracks(params, clips, frame_points, np.asarray(frame, np.int32))
        for frame, frame_points in points.items()
    }
    if 0 in inputs.query_points:
        tracks[0] = Tracks(first.tracks, first.track_visibility, first.track_confidence)  # type: ignore[arg-type]
    return Outputs(passes, assembly, tracks)
