"""4DVGGT-D (arXiv 2605.12027) on one page: all that reconstructs clips calls these two functions.

backbone features -> first pass, with motion cues -> dynamic mask -> second pass, with its keys suppressed
-> surgery and fusion
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, ParamSpec, Protocol, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.method.assembly import Assembly, FusionRule, as_tree, assemble
from vggtjax.method.matched_mask import Mined
from vggtjax.method.motion import FEWEST_FRAMES
from vggtjax.method.passes import Passes, first_pass, mine, mine_softly, only, second_pass, track_from
from vggtjax.method.soft_mask import SoftMasking
from vggtjax.method.witnesses import Seen
from vggtjax.network.backbone import encode
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.frames import BY_FRAME, WHOLE, Frames
from vggtjax.network.layers import Params
from vggtjax.network.precision import Compute
from vggtjax.network.track_head import Tracks
from vggtjax.options import Options

Images = Float[Array, "B S H W 3"]
Masks = Bool[Array, "B S H W"] | Float[Array, "B S H W"] | SoftMasking | Literal[False] | None
FIRST_OUTPUTS = ("camera", "depth")
_CLIPS = ClipBatch(BY_FRAME, BY_FRAME, WHOLE)  # type: ignore[arg-type]
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


class Step(Protocol):
    """What becomes of a step: it is a part of the caller's program (`inline`), or is timed, or compiled ahead.

    Arrays are positional arguments of the step, static values its keywords.
    """

    def __call__(self, name: str, function: Callable[_Parameters, _Result], /) -> Callable[_Parameters, _Result]:
        """Return the function to call in place of the step's own."""
        ...


def inline(name: str, function: Callable[_Parameters, _Result], /) -> Callable[_Parameters, _Result]:
    """Return the function itself."""
    del name
    return function


class Clips(NamedTuple):
    """A batch of clips to reconstruct."""

    images: Images  # RGB in [0, 1]; H and W are multiples of the patch size
    frame_count: Int[Array, " B"] | None = None  # real frames of each clip, its first ones; None: all
    query_points: Mapping[int, Float[Array, "B Q 2"]] = MappingProxyType({})  # points to track, by frame
    frames: int | None = None  # real frames of all clips, where shares of devices or padding have more; None: all

    @property
    def counted(self) -> int:
        """The number of real frames."""
        return self.images.shape[1] if self.frames is None else self.frames

    def real(self, frames: Frames) -> Frames:
        """Return where the real frames are, for `frames` of the passes."""
        return Frames(frames.mesh, None if self.counted == self.images.shape[1] else self.counted)


class Outputs(NamedTuple):
    """What a method makes of clips."""

    passes: Passes
    assembly: Assembly
    tracks: dict[int, Tracks]  # by the frame of their query points


def run_method(
    params: Params,
    clips: Clips | Images,
    config: VGGTConfig,
    options: Options = Options(),
    *,
    masks: Masks = None,
    fusion: FusionRule | None = None,
    both_outputs: bool = False,
    compute: Compute | None = None,
    step: Step = inline,
) -> Outputs:
    """Reconstruct clips by a method. Pure: works under jit, grad and vmap; `infer` is its jit.

    Args:
        params: the model's parameter tree.
        clips: images, or `Clips`.
        config: the model's configuration.
        options: the method and its settings; masks are not refined, as that is done on the host.
        masks: what moves: boolean or shares in [0, 1]; False: nothing; `SoftMasking`: mined with gradients; None:
            mined by the options. Masks are empty in clips whose frames are all one picture.
        fusion: a rule of fusion in place of the paper's, as for `assemble`.
        both_outputs: predict depth in the second pass even if the method does not read it.
        compute: how the network is computed; by the options and the platform if None.
        step: what becomes of every step.
    """
    clips = clips if isinstance(clips, Clips) else Clips(clips)
    compute = compute or Compute.of(options)
    passes, tracks = _passes(params, clips, config, options, masks, None, both_outputs, compute, step)
    frames = clips.real(compute.frames)
    cameras = "adjusted" if _adjusts(options, clips.counted) else "predicted"
    how = {"method": options.method, "align_scale": options.align_scale, "cameras": cameras, "frames": frames}
    join = step("assemble", frames.on_devices(assemble, BY_FRAME, WHOLE))
    assembly = join(passes._replace(patch_tokens=None), as_tree(fusion), **how)
    return Outputs(passes, assembly, tracks)


def run_passes(
    params: Params,
    clips: Clips | Images,
    config: VGGTConfig,
    options: Options = Options(),
    *,
    masks: Masks = None,
    shared: Passes | None = None,
    both_outputs: bool = False,
    compute: Compute | None = None,
    step: Step = inline,
) -> Passes:
    """Run both passes once, for `assemble`.

    The passes of the default options serve all methods of `LADDER`; "vggt4d" and "4dvggt-m" need their own.

    Args:
        params, clips, config, options, masks, both_outputs, compute, step: as for `run_method`.
        shared: passes over the same clips whose features and first pass are taken; they mined with the same `gram`,
            and have matches if the options read them.
    """
    clips = clips if isinstance(clips, Clips) else Clips(clips)
    compute = compute or Compute.of(options)
    return _passes(params, clips, config, options, masks, shared, both_outputs, compute, step)[0]


def _passes(
    params: Params,
    clips: Clips,
    config: VGGTConfig,
    options: Options,
    masks: Masks,
    shared: Passes | None,
    both_outputs: bool,
    compute: Compute,
    step: Step,
) -> tuple[Passes, dict[int, Tracks]]:
    """Features, first pass, mask, second pass; and the tracks of the query points."""
    method, images, on_devices = options.row, clips.images, compute.frames.on_devices
    _check_masks(masks, images)
    real, counted = clips.real(compute.frames), clips.counted
    if masks is None and counted == 1:
        masks = False  # nothing moves in a single frame
    mines_by_matches = masks is None and method.mask == "matches" and counted >= FEWEST_FRAMES
    witness = "matches" if mines_by_matches or _adjusts(options, counted) else "gram"

    # Features of the backbone, which both passes share.
    if shared is None:
        features = step("image features", on_devices(encode, WHOLE, BY_FRAME))
        tokens = features(params, images, config=config, compute_dtype=compute.compute_dtype, remat=compute.remat)
    else:
        tokens = shared.patch_tokens
    batch = ClipBatch(images, tokens, clips.frame_count)

    # Stage 1: a plain pass, which adds up the similarities of q and k that tell motion.
    if shared is None:
        exponents = masks.exponents if isinstance(masks, SoftMasking) else None
        plain = step("first pass", on_devices(first_pass, WHOLE, _CLIPS, WHOLE, WHOLE))
        how = {"gram": method.gram, "witness": witness, "compute": compute}
        first, seen = plain(params, batch, clips.query_points.get(0), exponents, config=config, **how)
    else:
        first, seen = shared.first, Seen(shared.saliency, shared.matches)

    # What moves.
    threshold = config.motion.cut_by(options.threshold, method.threshold)
    mined = Mined(masks)  # type: ignore[arg-type]
    if masks is None:
        read = (seen, only(first, FIRST_OUTPUTS)) if mines_by_matches else (Seen(seen.saliency), None)
        how = {"clusters": method.clusters, "threshold": threshold, "smooth_frames": options.smooth_frames}
        mining = step("dynamic mask", real.on_devices(mine, BY_FRAME, BY_FRAME, BY_FRAME))
        mined = mining(*read, batch._replace(frame_count=None), **how, frames=real)
    elif isinstance(masks, SoftMasking):
        shares = step("dynamic mask", mine_softly)
        mined = Mined(shares(seen.saliency, images, masks, threshold=config.motion.threshold or "otsu"))
    elif masks is False:
        mined = Mined(np.zeros(images.shape[:4], bool))  # type: ignore[arg-type]

    # Stage 2: the keys of what moves are suppressed.
    second = None
    if method.needs_second_pass:
        second = first
    if second is not None and masks is not False:
        outputs = FIRST_OUTPUTS if both_outputs else method.second_outputs(options.align_scale)
        strength = masks.strength if isinstance(masks, SoftMasking) else None
        pairs = config.motion.masked_pairs(options.mask_pairs) if strength is None else None
        masked = step("second pass", on_devices(second_pass, WHOLE, _CLIPS, BY_FRAME, BY_FRAME, WHOLE, WHOLE))
        unchanged = only(first, FIRST_OUTPUTS)
        how = {"suppress": method.suppress, "outputs": outputs, "compute": compute}
        second = masked(params, batch, mined.dynamic_mask, unchanged, pairs, strength, config=config, **how)

    tracks = {}
    for frame, points in clips.query_points.items():
        if frame == 0:
            tracks[0] = Tracks(first.tracks, first.track_visibility, first.track_confidence)  # type: ignore[arg-type]
        else:
            follow = step("tracks", on_devices(track_from, WHOLE, _CLIPS, WHOLE, WHOLE))
            tracks[frame] = follow(params, batch, points, np.asarray(frame, np.int32), config=config, compute=compute)
    return Passes(first, second, seen.saliency, *mined, seen.matches, tokens), tracks


def _adjusts(options: Options, frames: int) -> bool:
    """Return whether cameras are adjusted to matches: a single frame has none."""
    return options.cameras == "adjusted" and frames > 1


def _check_masks(masks: Masks, images: Images) -> None:
    """Raise InputError for masks of another shape or type."""
    if masks is None or masks is False or isinstance(masks, SoftMasking):
        return
    is_mask = masks.dtype == bool or jnp.issubdtype(masks.dtype, jnp.floating)
    if tuple(masks.shape) != tuple(images.shape[:4]) or not is_mask:
        raise InputError(
            f"masks are {masks.dtype} of shape {tuple(masks.shape)}; expected bool, or shares as floats, of shape "
            f"{tuple(images.shape[:4])}: one value for each pixel of the images"
        )
