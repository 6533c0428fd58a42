"""What a reconstruction reads besides the model: the clip at the model's size, its masks, points and known geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.clip import Clip, load_clip
from vggtjax.clips.masks import load_masks, masks_at_clip_pixels
from vggtjax.clips.preprocessing import Framing
from vggtjax.clips.queries import Queries
from vggtjax.clips.sources import ClipSource
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.known.given import Given, check_readable, read_known
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.progress import OnStage

GivenMasks = Bool[np.ndarray, "S h w"] | str | Path | Literal[False]


class Inputs(NamedTuple):
    """What is read before the network runs."""

    clip: Clip
    tracks: Queries | None
    masks: Bool[np.ndarray, "S H W"] | None  # given ones, or empty ones of equal frames; None: they are mined
    mask_source: str
    geometry: Given | None


def read_inputs(
    model: Model,
    clip: Clip | ClipSource,
    *,
    size: int | None,
    masks: GivenMasks | None,
    tracks: Queries | None,
    known: KnownGeometry | None,
    on_stage: OnStage,
) -> Inputs:
    """Read what `reconstruct` was given; arguments and errors as there."""
    if known is not None:
        check_readable(known)
    source, (clip, tracks) = clip, _fitted(model, clip, size, tracks, on_stage)
    empty, mask_source = np.zeros(clip.images.shape[:3], bool), "mined" if masks is None else "given"
    if masks is False:
        given = empty
    elif masks is not None:
        given = masks_at_clip_pixels(masks, clip, source if isinstance(source, Clip) else clip)
    elif clip.is_still:
        given, mask_source = empty, "none: all frames are equal"
    else:
        given = None
    geometry = None
    if known:
        left_out = None if known.leave_out is None else load_masks(known.leave_out, clip)
        capture = clip.source.capture if isinstance(clip.source, CaptureFrames) else None
        geometry = read_known(known, clip, leave_out=left_out, capture=capture)
    return Inputs(clip, tracks, given, mask_source, geometry)


def _fitted(
    model: Model, clip: Clip | ClipSource, size: int | None, tracks: Queries | None, on_stage: OnStage
) -> tuple[Clip, Queries | None]:
    """Return the clip at the model's size and patch size, and the points to track in its pixels."""
    if not isinstance(clip, Clip):
        if tracks is not None:
            raise InputError("tracks are points in pixels of a loaded clip; load the clip with load_clip first")
        with on_stage("load clip") as progress:
            return load_clip(clip, model=model, size=size, progress=progress), None
    if tracks is not None:
        check_tracks(model)
        tracks.check(*clip.images.shape[:3])
    fitter = Framing(size=size).fitter(model.config)
    if (clip.size, clip.patch) != (fitter.size, fitter.patch):
        with on_stage("fit clip to model"):
            loaded, clip = clip, clip.refit(fitter.size, fitter.patch)
            tracks = None if tracks is None else tracks.moved(loaded, clip)
    return clip, tracks


def check_tracks(model: Model) -> None:
    """Raise InputError for a model that follows no points."""
    if "tracks" not in model.heads:
        raise InputError(f"tracks need a model that follows points; this one has the heads {', '.join(model.heads)}")
