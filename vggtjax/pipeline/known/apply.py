"""What is known of a clip, brought into its result: masks, then intrinsics, poses, scale."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable

import numpy as np

from vggtjax.cameras import world_from_camera, zoomed
from vggtjax.pipeline.known.consistency import consistent_with_poses
from vggtjax.pipeline.known.depths import captured_depths, sampled_depths
from vggtjax.pipeline.known.given import Given
from vggtjax.pipeline.known.intrinsics import shared_focal
from vggtjax.pipeline.known.metric import MetricScale, from_baseline, from_camera_height, from_depths
from vggtjax.pipeline.known.options import SOURCE
from vggtjax.pipeline.known.poses import check_agreement
from vggtjax.results.result import AnyResult, Result

_LARGE_TURN = 15.0  # degrees between predicted and known poses, in the middle
_LARGE_OFFSET = 0.25  # of the path
_UNEQUAL = 0.02  # share by which focal lengths across and down a picture have to differ to be told apart

logger = logging.getLogger(__name__)


def apply_known(
    result: AnyResult, given: Given, refine: Callable[[AnyResult], AnyResult] | None = None
) -> tuple[AnyResult, float]:
    """Return the result with known intrinsics, poses and scale, and without the depth that is to be left out.

    Args:
        result: a prediction.
        given: what is known of its frames, as `read_known` returns it.
        refine: refines the cameras; called when the intrinsics are known, and before lengths are.

    Returns:
        The result, whose settings hold what was given and what the fits left over, as sentences by step; and how long
        the unit of the prediction is in its own.

    Raises:
        InputError: known values that do not fit the prediction.
    """
    known, notes, unit = given.options, {}, 1.0
    if given.leave_out is not None:
        depth, moving = np.where(given.leave_out, np.float32(0), result.depth), result.dynamic_mask & ~given.leave_out
        result = dataclasses.replace(result, depth=depth, dynamic_mask=moving)
        notes["left out"] = f"{given.leave_out.sum() / result.inside_pictures.sum():.1%} of the pixels"
    if given.intrinsics is not None or known.shared_focal:
        result = _with_intrinsics(result, given, notes)
    if given.poses is not None:
        result, unit = _with_poses(result, given, notes)
    if refine is not None:
        result = refine(result)
    scale = _metric_scale(result, given)
    lengths = _unit(given, scale)
    if scale is not None:
        result, unit = scaled(result, scale.factor), unit * scale.factor
        words = "metres" if lengths == "metre" else "units of the capture"
        notes["scale"] = f"{scale.factor:.4g} {words} per unit: {scale.note}"
    settings = result.settings | {"known": known.to_json() | {"found": notes, "lengths": lengths}}
    return dataclasses.replace(result, settings=settings), unit


def scaled(result: AnyResult, factor: float) -> AnyResult:
    """Return the result with depth and camera centres times a factor."""
    poses = result.camera_from_world.astype(np.float64)
    poses[:, :, 3] *= factor
    return dataclasses.replace(
        result, depth=result.depth * np.float32(factor), camera_from_world=poses.astype(np.float32)
    )


def _with_intrinsics(result: AnyResult, given: Given, notes: dict[str, str]) -> AnyResult:
    name = "shared focal length" if given.intrinsics is None else "intrinsics"
    intrinsics = shared_focal(result) if given.intrinsics is None else given.intrinsics
    if given.options.intrinsics == SOURCE and given.capture is not None and given.capture.distorted:
        logger.warning(
            "the lens of %s has a distortion, which its intrinsics do not describe: points near the borders of the "
            "pictures are off; undistort the pictures (the default where the coefficients are known)",
            given.capture.path,
        )
    change = np.log(intrinsics[:, [0, 1], [0, 1]] / result.intrinsics[:, [0, 1], [0, 1]])
    focal = np.median(intrinsics[:, 0, 0] * result.source_scale[:, 0])
    across, down = np.expm1(np.median(change, axis=0))
    notes[name] = f"focal length {focal:.5g} pixels of the source, {across:+.1%} against the prediction"
    if abs(across - down) > _UNEQUAL:
        notes[name] += f" (down the picture {down:+.1%})"
    return dataclasses.replace(result, intrinsics=intrinsics.astype(np.float32))


def _with_poses(result: AnyResult, given: Given, notes: dict[str, str]) -> tuple[AnyResult, float]:
    poses = world_from_camera(np.asarray(given.poses)[:, :3])[:, :3]  # the inverse of a rigid transform
    found = check_agreement(result.camera_from_world.astype(np.float64), poses, given.poses_name)
    notes["poses"] = (
        f"the predicted ones differ by {found.turn_median:.2g} degrees (median; at most {found.turn_most:.2g}) and "
        f"{found.centres:.2%} of the path (RMSE of the centres)"
    )
    if found.turn_median > _LARGE_TURN or found.centres > _LARGE_OFFSET:
        logger.warning("the known poses fit poorly: %s; are they of these frames?", notes["poses"])
    posed = dataclasses.replace(
        result, depth=result.depth * np.float32(found.scale), camera_from_world=poses.astype(np.float32)
    )
    made = consistent_with_poses(posed, focal_known=given.intrinsics is not None)
    intrinsics, depth = zoomed(posed.intrinsics, made.focal), posed.depth * made.depth.astype(np.float32)
    notes["depth by poses"] = (
        f"changed by {np.abs(np.log(made.depth)).mean():.1%} on average, so that the correlation between frames goes "
        f"from {1 - made.cost[0]:.2f} to {1 - made.cost[1]:.2f}"
        + ("" if given.intrinsics is not None else f"; focal length {made.focal - 1:+.1%}")
    )
    factor = np.median(made.depth[posed.valid_pixels]) if posed.valid_pixels.any() else 1.0
    return dataclasses.replace(posed, depth=depth, intrinsics=intrinsics), found.scale * float(factor)


def _metric_scale(result: Result, given: Given) -> MetricScale | None:
    known = given.options
    if given.baseline is not None:
        return from_baseline(result, given.baseline)
    if known.camera_height is not None:
        return from_camera_height(result, known.camera_height)
    name, depths = str(known.known_depths), given.depths
    if given.depth_maps is not None:
        depths = sampled_depths(given.depth_maps, result, name)
    elif known.known_depths == SOURCE and given.capture is not None:
        name, depths = str(given.capture.path), captured_depths(given.capture, result)
    return None if depths is None else from_depths(result, depths, name, robust=known.robust)


def _unit(given: Given, scale: MetricScale | None) -> str:
    """Return the unit of lengths, as `Result.length_unit` tells it."""
    known = given.options
    recorded = known.known_depths == SOURCE if scale is not None else known.poses == SOURCE
    if recorded:
        return "metre" if given.capture is not None and given.capture.metric else "unit of the capture"
    if scale is not None:
        return "metre"
    return "unit of the model" if known.poses is None else "unit of the poses"
