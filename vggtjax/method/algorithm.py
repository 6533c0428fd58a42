"""4DVGGT-D (arXiv 2605.12027) on one page: all that reconstructs clips calls `run_method` or `run_passes`.

backbone features -> first pass, with motion cues -> dynamic mask -> second pass, with its keys suppressed
-> surgery and fusion
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, ParamSpec, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import VGGTConfig, Witness
from vggtjax.errors import InputError
from vggtjax.method.assembly import Assembly, FusionRule, as_tree, assemble, check_fuses
from vggtjax.method.matching.matched_mask import MotionMask
from vggtjax.method.matching.matched_motion import FEWEST_FRAMES
from vggtjax.method.matching.witnesses import Evidence
from vggtjax.method.passes import Passes, first_pass, mine, mine_soft, only, second_pass, track_from
from vggtjax.method.soft_mask import SoftMasking
from vggtjax.network.backbone import ClipBatch, encode
from vggtjax.network.given import as_array, as_images
from vggtjax.network.heads.track_head import Tracks
from vggtjax.network.kernels.frames import BY_FRAME, REPLICATED, Frames
from vggtjax.network.layers import Params
from vggtjax.network.model import Predictions
from vggtjax.network.precision import Compute
from vggtjax.options import Options

Images = Float[Array, "B S H W 3"]
Masks = Bool[Array | np.ndarray, "B S H W"] | Float[Array | np.ndarray, "B S H W"] | SoftMasking | Literal[False] | None
FIRST_OUTPUTS = ("camera", "depth")
_CLIPS = ClipBatch(BY_FRAME, BY_FRAME, REPLICATED, BY_FRAME)  # type: ignore[arg-type] # where its parts are on several devices
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


@partial(jax.tree_util.register_dataclass, data_fields=("images", "query_points", "cameras"), meta_fields=("frames",))
@dataclass(frozen=True)
class Clips:
    """A batch of clips to reconstruct: a pytree, whose `frames` is static under jit.

    Attributes:
        images: RGB in [0, 1]; H and W are multiples of the patch size.
        query_points: x, y in pixels of points to track, by the frame in which they are given.
        frames: number of real frames, the first ones. The others change nothing: they make clips of similar length
            share compiled programs, or shares of devices equal. None: all are real.
        cameras: known cameras, as pose encodings, for a network that reads them.
    """

    images: Images
    query_points: Mapping[int, Float[Array, "B Q 2"]] = field(default_factory=dict)
    frames: int | None = None
    cameras: Float[Array, "B S 9"] | None = None

    @classmethod
    def given(cls, clips: Clips | Images) -> Clips:
        """Return clips, or images, as a caller gives them. Raises InputError for images that are not finite."""
        clips = clips if isinstance(clips, cls) else cls(clips)  # type: ignore[arg-type]
        points = {frame: as_array("query_points", points) for frame, points in clips.query_points.items()}
        return replace(clips, images=as_images(clips.images), query_points=points)

    @property
    def counted(self) -> int:
        """The number of real frames."""
        return self.images.shape[1] if self.frames is None else self.frames

    def real(self, frames: Frames) -> Frames:
        """Return where the real frames are, for `frames` of the passes."""
        return Frames(frames.mesh, None if self.counted == self.images.shape[1] else self.counted)

    def padding(self, frames: Frames) -> Int[Array, " B"] | None:
        """Return the number of real frames of each clip, to be traced; None where `frames` of the passes has it."""
        B, S = self.images.shape[:2]
        passed = S if frames.mesh is None or frames.count is None else frames.count
        return None if self.counted == passed else np.full(B, self.counted, np.int32)  # type: ignore[return-value]

    def check(self, frames: Frames) -> None:
        """Raise InputError for an invalid number of frames, and for points to track in padded clips."""
        S = self.images.shape[1]
        if not 1 <= self.counted <= S:
            raise InputError(f"frames is {self.counted}; expected a number from 1 to {S}, the frames of the images")
        if self.query_points and (frames.mesh is not None or self.padding(frames) is not None):
            raise InputError(
                "clips with query_points are padded, or on several devices; points are followed on one device, in "
                "clips whose frames are all real"
            )


def compute_by(options: Options, frames: Frames = Frames(), on_accelerator: bool | None = None) -> Compute:
    """Return how the network is computed by options, with the platform's values in place of None.

    `on_accelerator` is as for `Options.computed`.
    """
    options = options.computed(on_accelerator)
    return Compute(
        str(options.compute_dtype),
        str(options.precision),
        attention=options.attention,
        reference=options.reference,
        frames=frames,
    )


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
) -> tuple[Assembly, Passes]:
    """Reconstruct clips by a method. Pure: works under jit, grad and vmap; `infer` is its jit.

    Under a jit of your own, close over `config` and `options`, or name them:
    `jax.jit(run_method, static_argnames=("config", "options"))`. Parameters, clips, masks (but False), and a tree or a
    `Partial` as `fusion` can be traced.

    Args:
        params: the model's parameter tree.
        clips: images, or `Clips`.
        config: the model's configuration.
        options: the method and its settings; masks are not refined, as that is done on the host.
        masks: what moves: boolean or shares in [0, 1]; False: nothing; `SoftMasking`: mined with gradients, cut by
            the model's threshold; None: mined by the options. Mined and soft masks are empty in clips whose frames are
            all one picture.
        fusion: a rule of fusion in place of the paper's, as for `assemble`.
        both_outputs: predict depth in the second pass even if the method does not read it.
        compute: how the network is computed; by the options and the platform if None.
        step: what becomes of every step.

    Returns depth, confidence and cameras, and the passes they were made of.
    """
    clips = Clips.given(clips)
    compute = compute or compute_by(options)
    check_fuses(fusion, options.method)
    passes = run_passes(
        params, clips, config, options, masks=masks, both_outputs=both_outputs, compute=compute, step=step
    )
    frames = clips.real(compute.frames)
    join = step("assemble", assemble)
    arrays = (passes._replace(features=None, tracks=None), as_tree(fusion))
    made = join(*arrays, method=options.method, align_scale=options.align_scale, frames=frames)
    return made, passes


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

    The passes of the default options serve all methods of `ABLATION`; "vggt4d" and "4dvggt-m" need their own.

    Args:
        params, clips, config, options, masks, both_outputs, compute, step: as for `run_method`.
        shared: passes over the same clips whose features and first pass are taken; they mined with the same `gram`,
            and have matches if the options read them.
    """
    clips = Clips.given(clips)
    masks = given_masks(masks)
    compute = compute or compute_by(options)
    method, images, on_devices = options.row, clips.images, compute.frames.on_devices
    clips.check(compute.frames)
    check_masks(masks, images, compute.frames)
    real = clips.real(compute.frames)
    # Masks are given from here on, or soft, or None: to be mined.
    soft = masks if isinstance(masks, SoftMasking) else None
    nothing_moves = masks is False or (masks is None and clips.counted == 1)
    if nothing_moves:
        masks = np.zeros(images.shape[:4], bool)
    mines_by_matches = masks is None and method.mask == "matches" and clips.counted >= FEWEST_FRAMES
    witness = "matches" if mines_by_matches else "gram"

    if shared is None:
        # Features of the backbone, which both passes share.
        features = step("image features", on_devices(encode, REPLICATED, BY_FRAME))
        made = features(params, images, config=config, compute_dtype=compute.compute_dtype, remat=compute.remat)
        batch = ClipBatch(images, made, clips.padding(compute.frames), clips.cameras)
        # Stage 1: a plain pass, which adds up the similarities of q and k that tell motion.
        exponents = None if soft is None else soft.exponents
        plain_pass = step("first pass", on_devices(first_pass, REPLICATED, _CLIPS, REPLICATED, REPLICATED))
        arrays = (params, batch, clips.query_points.get(0), exponents)
        first, seen = plain_pass(*arrays, config=config, gram=method.gram, witness=witness, compute=compute)
    else:
        _check_shared(shared, masks, witness)
        batch = ClipBatch(images, shared.features, clips.padding(compute.frames), clips.cameras)
        first, seen = shared.first, Evidence(shared.saliency, shared.matches)

    # What moves.
    threshold = config.motion.cut_by(options.threshold, method.threshold)
    if soft is not None:
        shares = step("dynamic mask", mine_soft)
        cut = config.motion.threshold or "otsu"
        moving = MotionMask(shares(seen.saliency, images, soft, threshold=cut, frames=real))
    elif masks is None:
        mining = step("dynamic mask", mine)
        read = (seen, only(first, FIRST_OUTPUTS)) if mines_by_matches else (Evidence(seen.saliency), None)
        how = {"clusters": method.clusters, "threshold": threshold, "smooth_frames": options.smooth_frames}
        moving = mining(*read, batch._replace(frame_count=None), **how, frames=real)
    else:
        moving = MotionMask(masks)  # type: ignore[arg-type]

    # Stage 2: the keys of what moves are suppressed.
    second = first if method.needs_second_pass else None
    if second is not None and not nothing_moves:
        outputs = FIRST_OUTPUTS if both_outputs else method.second_outputs(options.align_scale)
        strength = None if soft is None else soft.strength
        pairs = config.motion.masked_pairs(options.mask_pairs) if strength is None else None
        masked_pass = step(
            "second pass", on_devices(second_pass, REPLICATED, _CLIPS, BY_FRAME, BY_FRAME, REPLICATED, REPLICATED)
        )
        arrays = (params, batch, moving.dynamic_mask, only(first, FIRST_OUTPUTS), pairs, strength)
        second = masked_pass(*arrays, config=config, suppress=method.suppress, outputs=outputs, compute=compute)

    tracks = _follow(params, batch, clips.query_points, first, config, compute, step) if clips.query_points else None
    return Passes(first, second, seen.saliency, *moving, seen.matches, batch.features, tracks)


def _follow(
    params: Params,
    batch: ClipBatch,
    query_points: Mapping[int, Float[Array, "B Q 2"]],
    first: Predictions,
    config: VGGTConfig,
    compute: Compute,
    step: Step,
) -> dict[int, Tracks]:
    """Return tracks by the frame in which their points are given; the first pass has those of frame 0."""
    follow = step("tracks", track_from)
    tracks = {
        frame: follow(params, batch, points, np.asarray(frame, np.int32), config=config, compute=compute)
        for frame, points in query_points.items()
        if frame != 0
    }
    if 0 in query_points:
        tracks[0] = Tracks(first.tracks, first.track_visibility, first.track_confidence)  # type: ignore[arg-type]
    return tracks


def given_masks(masks: Masks) -> Masks:
    """Return masks of any library as an array."""
    return masks if masks is None or masks is False or isinstance(masks, SoftMasking) else as_array("masks", masks)


def check_masks(masks: Masks, images: Images, frames: Frames = Frames()) -> None:
    """Raise InputError for masks of another shape or type, and for soft ones on several devices."""
    if isinstance(masks, SoftMasking):
        if frames.mesh is not None:
            raise InputError("masks are soft and frames are on several devices; soft masks take one device")
        return
    if masks is None or masks is False:
        return
    shape, dtype = tuple(np.shape(masks)), getattr(masks, "dtype", None)
    if dtype is not None and not any(jnp.issubdtype(dtype, kind) for kind in (jnp.bool_, jnp.floating)):
        raise InputError(f"masks have type {dtype}; expected bool, or shares as floats: masks.astype(bool)")
    if dtype is None or shape != tuple(images.shape[:4]):
        raise InputError(
            f"masks are {dtype or type(masks).__name__} of shape {shape}; expected an array of bool, or of shares as "
            f"floats, of shape {tuple(images.shape[:4])}: one value for each pixel of the images; or False where "
            "nothing moves"
        )


def _check_shared(shared: Passes, masks: Masks, witness: Witness) -> None:
    """Raise InputError for passes that lack what is read of them."""
    if shared.features is None:
        raise InputError("shared has no features; expected what run_passes returned")
    if witness == "matches" and shared.matches is None:
        raise InputError("shared has no matches between frames; run its passes with the same mask")
    if isinstance(masks, SoftMasking):
        raise InputError("masks are soft and change the first pass; leave shared out")
