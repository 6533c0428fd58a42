"""Bundle adjustment of a result: better cameras over matches of the source's pictures, or the network's, and why."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count
from typing import Any, Generic, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from vggtjax.cameras import Cameras
from vggtjax.errors import InputError, check_extra
from vggtjax.pipeline.refinement.adjust import Adjusted, adjust, quiet, reprojection_errors
from vggtjax.pipeline.refinement.field import Measured
from vggtjax.pipeline.refinement.mapping import Matched, map_globally, nearest_to_rays
from vggtjax.pipeline.refinement.matches import find_features, frame_pairs, match_pairs, working_unit
from vggtjax.pipeline.refinement.points import measured_at_points
from vggtjax.pipeline.refinement.tracks import Tracks, dense_depth_at, join_matches, starting_points
from vggtjax.progress import Progress, no_progress
from vggtjax.results.result import AnyResult, Result

_SCHEDULES = ((1, 1), (4, 2, 1, 1))
"""Scales of the loss in working pixels, for adjustments that start at the network's cameras."""
_AFTER_MAPPING = (4, 2, 1, 1)
_ROUNDS = sum(map(len, (*_SCHEDULES, _AFTER_MAPPING)))
_FEWEST_POINTS = 24
_FEWEST_OF_FRAME = 10  # observations; fewer do not hold a camera
_MOST_SPREAD = 2.0  # factor by which adjusted and dense depth may differ (median), after one scale

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RefinementReport:
    """What came of a refinement: whether the cameras were refined, over how many points, and the errors."""

    refined: bool
    reason: str = ""  # why the network's cameras were kept
    frames: int = 0
    points: int = 0
    observations: int = 0
    error_before: float | None = None  # median reprojection error in pixels of the source
    error_after: float | None = None

    @property
    def sentence(self) -> str:
        """What a summary says."""
        if not self.refined:
            return f"the network's cameras were kept: {self.reason}"
        before = "unknown" if self.error_before is None else f"{self.error_before:.2f}"
        return (
            f"reprojection error {before} -> {self.error_after:.2f} pixels over {self.points} points in "
            f"{self.frames} frames"
        )


class Refined(NamedTuple, Generic[AnyResult]):
    """A result whose cameras were refined, or kept."""

    result: AnyResult
    report: RefinementReport
    points: Measured | None  # the depths of its points over the result's; None where the cameras were kept


def check_refinement(wanted: bool, known_poses: bool = False) -> None:
    """Raise MissingExtraError without pycolmap, and InputError for known poses; call it before long work."""
    if wanted:
        check_extra("refining cameras", "colmap", "pycolmap")
        if known_poses:
            raise InputError("refine_cameras and known poses exclude each other; give one of them")


def warn_of_kept(report: RefinementReport) -> None:
    """Log a warning if the network's cameras were kept."""
    if not report.refined:
        logger.warning("%s", report.sentence)


def refine_with_points(
    result: AnyResult,
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]],
    *,
    fixed_intrinsics: bool = False,
    progress: Progress | None = None,
) -> Refined[AnyResult]:
    """Return the result with cameras that agree with matches between its pictures, a report, and the points' depths.

    SIFT features on static pixels are matched between frames; their tracks start where the dense depth puts them. A
    bundle adjustment with a Cauchy loss then moves cameras, points and one focal length. It is run from several starts:
    the network's cameras, with the loss from narrow to wide, and those of COLMAP's global mapper; the one that agrees
    best with the matches is taken. The depth, the first camera and the principal points stay, and the others come to
    the depth's scale. The network's cameras are kept where the matches are too few, the error does not fall, or the
    adjusted points contradict the dense depth.

    Args:
        result: cameras, depth and dynamic mask; the mask decides which pixels are matched.
        pictures: of the source, in the order of the frames (`Clip.pictures()`).
        fixed_intrinsics: the focal lengths are known and stay.
        progress: called with the number of steps done, and of all: pictures, pairs of frames, rounds of adjustment.

    Raises:
        MissingExtraError: pycolmap is not installed.
        ClipError: pictures that are missing, or of another size than the result's.
    """
    check_refinement(True)
    frames = len(result.depth)
    pairs = frame_pairs(frames)
    progress, total, done = progress or no_progress, frames + len(pairs) + _ROUNDS, count()

    def step() -> None:
        progress(next(done), total)

    step()
    unit = working_unit(result)
    with quiet():
        features = find_features(result, pictures, step)
        matches = match_pairs(features, pairs, unit, step)
    matched = Matched([each.positions for each in features], matches)
    tracks = join_matches(*matched, min(frames, 3))
    refined = adjust_to_tracks(
        result, tracks, matched=matched, unit=unit, fixed_intrinsics=fixed_intrinsics, on_round=step
    )
    progress(total, total)  # rounds that were not needed, too
    return refined


def adjust_to_tracks(
    result: AnyResult,
    tracks: Tracks,
    *,
    matched: Matched | None = None,
    unit: float = 1.0,
    fixed_intrinsics: bool = False,
    on_round: Callable[[], object] = lambda: None,
) -> Refined[AnyResult]:
    """Return what `refine_with_points` does, for given tracks.

    Args:
        result: as there.
        tracks: observations of static points.
        matched: the matches that the tracks are made of; without them no adjustment starts from COLMAP's mapper.
        unit: pixels of the source per working pixel.
        fixed_intrinsics: as there.
        on_round: called after each round of an adjustment.
    """
    start = Cameras(result.camera_from_world.astype(np.float64), _source_intrinsics(result))
    reason = _too_few(tracks, np.ones(len(tracks.frames), bool), len(result.depth))
    if reason:
        return _reported(result, RefinementReport(False, reason))
    points = starting_points(result, tracks)
    with quiet():
        adjusted = _best(result, start, points, tracks, matched, unit, fixed_intrinsics, on_round)
    if adjusted is None:
        return _reported(result, RefinementReport(False, "no adjustment converged"))
    kept = adjusted.kept
    if reason := _too_few(tracks, kept, len(result.depth)):
        return _reported(result, RefinementReport(False, f"after the adjustment {reason}"))
    before, after = (
        float(np.median(reprojection_errors(cameras, at, tracks)[kept]))
        for cameras, at in ((start, points), (adjusted.cameras, adjusted.points))
    )
    numbers: dict[str, Any] = {
        "frames": len(result.depth),
        "points": len(np.unique(tracks.points[kept])),
        "observations": int(kept.sum()),
        "error_before": before if np.isfinite(before) else None,
        "error_after": after,
    }
    poses, scale, spread = _fitted(adjusted, tracks, result)
    if after >= before:
        reason = f"the reprojection error did not fall from {before:.2f} pixels"
    elif spread > _MOST_SPREAD:
        reason = f"the adjusted points differ from the dense depth by a factor of {spread:.1f} (median)"
    if reason:
        return _reported(result, RefinementReport(False, reason, **numbers))
    K = result.intrinsics.astype(np.float64)
    focal = [0, 1]
    K[:, focal, focal] = adjusted.cameras.intrinsics[:, focal, focal] / result.source_scale
    refined = dataclasses.replace(result, camera_from_world=poses.astype(np.float32), intrinsics=K.astype(np.float32))
    points = measured_at_points(adjusted, tracks, result, scale)
    return _reported(refined, RefinementReport(True, **numbers), points)


def _fitted(adjusted: Adjusted, tracks: Tracks, result: Result) -> tuple[Float64[np.ndarray, "S 3 4"], float, float]:
    """Return the adjusted cameras in the world of the result, whose first camera and dense depth decide.

    The median depths agree at the scale of these cameras, the second value. The third is the factor, at least 1, by
    which adjusted and dense depth then still differ (median).
    """
    poses, kept = adjusted.cameras.camera_from_world, adjusted.kept
    seen_by = poses[tracks.frames[kept]]
    z = np.einsum("mj,mj->m", seen_by[:, 2, :3], adjusted.points[tracks.points[kept]]) + seen_by[:, 2, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(z / dense_depth_at(result, tracks)[kept])  # of unscaled adjusted depth by dense depth
    known = np.isfinite(logs)
    scale = float(np.exp(-np.median(logs[known])))
    spread = float(np.exp(np.median(np.abs(logs[known] + np.log(scale)))))
    first = result.camera_from_world[0].astype(np.float64)
    turn = poses[:, :, :3] @ poses[0, :, :3].T
    moved = scale * (poses[:, :, 3] - turn @ poses[0, :, 3])
    placed = np.concatenate([turn @ first[:, :3], (turn @ first[:, 3] + moved)[:, :, None]], axis=2)
    placed[0] = first  # to the last bit
    return placed, scale, spread


def _best(
    result: Result, start: Cameras, points, tracks: Tracks, matched: Matched | None, unit, fixed_intrinsics, on_round
) -> Adjusted | None:
    """Return the adjustment, of those from every start, that agrees best with the observations."""
    frames, sizes = len(result.depth), result.source_size
    fixed = fixed_intrinsics or frames == 2  # two frames do not hold a focal length
    starts = [(start, points, schedule) for schedule in _SCHEDULES]
    mapped = None if matched is None or frames < 3 else map_globally(start, sizes, matched, fixed)
    if mapped is not None:
        starts.append((mapped, nearest_to_rays(mapped, tracks), _AFTER_MAPPING))
    best = None
    for cameras, at, schedule in starts:
        scales = [scale * unit for scale in schedule]
        found = adjust(cameras, at, tracks, sizes, scales, least=min(frames, 3), fixed_focal=fixed, on_round=on_round)
        if found is not None and (best is None or found.agreement > best.agreement):
            best = found
    return best


def _reported(result: AnyResult, report: RefinementReport, points: Measured | None = None) -> Refined[AnyResult]:
    settings = result.settings | {"refined_cameras": {"sentence": report.sentence, **dataclasses.asdict(report)}}
    return Refined(dataclasses.replace(result, settings=settings), report, points)


def _too_few(tracks: Tracks, kept: Bool[np.ndarray, " M"], frames: int) -> str:
    """Return why these observations do not hold the cameras; empty if they do."""
    points = len(np.unique(tracks.points[kept]))
    if points < _FEWEST_POINTS:
        return f"{points} static points were matched; at least {_FEWEST_POINTS} are needed"
    seen = np.bincount(tracks.frames[kept], minlength=frames)
    if seen.min() < _FEWEST_OF_FRAME:
        few = f"frame {int(seen.argmin())} sees {int(seen.min())} matched points"
        return f"{few}; at least {_FEWEST_OF_FRAME} are needed"
    return ""


def _source_intrinsics(result: Result) -> Float64[np.ndarray, "S 3 3"]:
    """Return the intrinsics in pixels of the source."""
    K = result.intrinsics.astype(np.float64)
    K[:, :2] *= result.source_scale[:, :, None]
    K[:, :2, 2] += result.source_offset
    return K
