"""A result after the passes -> cameras and depth that agree with the pictures of its source, as the options say."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import UInt8

from vggtjax.options import Options
from vggtjax.pipeline.refinement.consistent import consistent_depth
from vggtjax.pipeline.refinement.dense import KNOWN, PREDICTED
from vggtjax.pipeline.refinement.pixel_mask import mask_by_pixels, takes_pixel_mask
from vggtjax.pipeline.refinement.refine import refine_with_points, warn_of_kept
from vggtjax.progress import OnStage, no_stage
from vggtjax.results.result import AnyResult

Pictures = Callable[[], Iterable[UInt8[np.ndarray, "h w 3"]]]


def agrees_with_pixels(options: Options) -> bool:
    """Return whether a result changes after the passes to agree with pixels."""
    return options.refine_cameras or options.consistent_depth


def agree_with_pixels(
    result: AnyResult,
    pictures: Pictures,
    options: Options,
    *,
    known_poses: bool = False,
    known_intrinsics: bool = False,
    on_stage: OnStage = no_stage,
) -> AnyResult:
    """Return the result with refined cameras and consistent depth, if the options say so.

    Consistent depth starts from refined cameras, and takes their points, if both are wanted. A mined mask that is not
    refined is mined by pixels after it.

    Args:
        result: of the passes.
        pictures: returns those of the source, from the first frame on.
        options: `refine_cameras` and `consistent_depth`.
        known_poses: the cameras are known and stay.
        known_intrinsics: the focal lengths are known and stay.
        on_stage: as for `Running`.
    """
    refined, priors = None, KNOWN if known_poses else PREDICTED
    if options.refine_cameras:
        with on_stage("refine cameras") as progress:
            refined = refine_with_points(result, pictures(), fixed_intrinsics=known_intrinsics, progress=progress)
        warn_of_kept(refined.report)
        result = refined.result
    if options.consistent_depth:
        if known_intrinsics:
            priors = dataclasses.replace(priors, focal=None)
        with on_stage("consistent depth") as progress:
            points = None if refined is None else refined.points
            result, _ = consistent_depth(result, pictures(), points=points, priors=priors, progress=progress)
        if takes_pixel_mask(result):  # pixels match better than the network, also around cameras that stayed
            with on_stage("mask by pixels"):
                result = mask_by_pixels(result, pictures())
        result = dataclasses.replace(result, settings=result.settings | {"consistent_depth": True})
    return result
