"""Depth and cameras that agree with the clip's own pixels, and one surface in place of a layer for each frame.

    cells of the frames, matched by their pixels -> adjustment -> cameras, and depths of cells
    these depths, and those of bundle-adjusted points, by their precision -> a smooth field of log scale for each frame
    depth of frames that see one surface -> their mean

No training and no optical flow; what moves is left out by the dynamic mask.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count

import numpy as np
import scipy
from jaxtyping import Float32, UInt8

from vggtjax.cameras import zoomed
from vggtjax.network.surroundings import own_settings
from vggtjax.pipeline.known.intrinsics import shared_focal
from vggtjax.pipeline.refinement.cells import Cells, cells_of, grey_pictures
from vggtjax.pipeline.refinement.dense import PREDICTED, ROUNDS, CameraPriors, DenseWorld, adjust_to_pixels
from vggtjax.pipeline.refinement.field import FieldPrior, Measured, at_pixels, fit_field
from vggtjax.pipeline.refinement.joining import differences, join_frame, tolerance_of
from vggtjax.pipeline.refinement.pixel_matches import FEWEST_MATCHED
from vggtjax.pipeline.refinement.turns import turned_by_features
from vggtjax.progress import Progress, no_progress
from vggtjax.results.result import AnyResult, Result
from vggtjax.storage.arrays import zeros_beside

FEWEST_FRAMES, MOST_FRAMES = 3, 512
_KNOWN = 4.0  # a deviation of a log depth of 0.5 is the largest that is known
_LEAST_PARALLAX = 0.3  # cells; with less, a wrong lens or shutter says more than depth does
_LEAST_TURN = 1.0  # degrees; cameras that turn less say nothing of the focal length
_MOST_ZOOM = 3e-5  # a frame; with more, a single focal length spoils depth
_MOST_WORSE = 1.6  # factor by which frames may differ more after the field, before they are joined
_MOST_TURNED = 0.3  # degrees by which pixels may turn bundle-adjusted cameras
_BEST = 400.0  # no log depth of a cell is known better than by a deviation of 0.05

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConsistencyReport:
    """What came of making a result consistent."""

    changed: bool
    reason: str = ""  # why depth and cameras stayed
    cells: float = 0.0  # share of the cells whose depth matched pixels tell; that match, if cameras change alone
    points: int = 0  # observations of bundle-adjusted points
    change: float = 0.0  # mean |log| by which depth changed
    layers_before: float | None = 0.0  # median |log| between depths of frames that see one place; None: none did
    layers_after: float = 0.0
    joined: float = 0.0  # share of the static pixels whose depth is the mean of several frames

    @property
    def sentence(self) -> str:
        """What a summary says."""
        if not self.changed:
            return f"depth and cameras stay as they were: {self.reason}"
        points = f" and {self.points} observations of points" if self.points else ""
        joined = f"; {self.joined:.0%} of the static pixels are joined" if self.joined else ""
        by = f"changed by {self.change:.1%} on average, to fit" if self.change else "not changed; only the cameras fit"
        before = "saw nothing in common" if self.layers_before is None else f"{self.layers_before:.1%}"
        return (
            f"{by} pixels in {self.cells:.0%} of the picture{points}; "
            f"frames differ by {self.layers_after:.1%} (median), {before} before{joined}"
        )


@own_settings()
def consistent_depth(
    result: AnyResult,
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None = None,
    *,
    points: Measured | None = None,
    priors: CameraPriors = PREDICTED,
    join: bool = True,
    progress: Progress | None = None,
) -> tuple[AnyResult, ConsistencyReport]:
    """Return the result with depth and cameras that agree with its pictures, and a report.

    Pixels that move take the field's value and keep their shape. Mask and confidence stay. The cameras change alone
    where there is hardly any parallax, where the lens zooms, or where the fields make the frames agree less. Depth and
    cameras stay, with a warning logged, where too little is matched or the frames would not agree better. Clips of one
    or two frames stay.

    Args:
        result: cameras, depth and dynamic mask.
        pictures: of the source, in the order of the frames (`Clip.pictures()`); the result's own images if None.
        points: depths of bundle-adjusted points over the result's, as `refine_with_points` returns them with its
            cameras; fitted too where the pixels agree with these cameras.
        priors: how far the cameras may go.
        join: take the mean of what several frames see.
        progress: called with the number of steps done, and of all.

    Raises ClipError for pictures that are missing, or of another size than the result's.
    """
    frames, size = len(result.depth), (result.depth.shape[1], result.depth.shape[2])
    total, done, tell = len(ROUNDS) + 6 * frames, count(), progress or no_progress

    def step() -> None:
        tell(next(done), total)

    step()
    if not FEWEST_FRAMES <= frames <= MOST_FRAMES:
        counted = "1 frame" if frames == 1 else f"{frames} frames"
        reason = f"the clip has {counted}; {FEWEST_FRAMES} to {MOST_FRAMES} are adjusted together"
        return _kept(result, reason, warns=frames > MOST_FRAMES)
    start = result
    if priors.focal is not None:  # one focal length: errors of single ones would hold other cameras in wrong places
        start = dataclasses.replace(result, intrinsics=shared_focal(result).astype(np.float32))
    cells = cells_of(start)
    if (share := cells.is_static.mean()) < FEWEST_MATCHED:
        return _kept(
            result, f"{share:.1%} of the picture shows what does not move; at least {FEWEST_MATCHED:.0%} is needed"
        )
    grey = grey_pictures(result, pictures, cells.grid)
    starts = []
    if points is None and not priors.fixed:  # neither bundle-adjusted nor known cameras
        starts = [turned] if (turned := turned_by_features(cells, grey, on_frame=step)) is not None else []
    world = adjust_to_pixels(cells, grey, priors, on_round=step, starts=starts)
    if points is not None and _turned(start, world) > _MOST_TURNED:
        points = None  # the bundle adjustment ended in a wrong place
    if world.matched < FEWEST_MATCHED or not np.isfinite(world.camera_from_world).all():
        share = f"{world.matched:.1%} of the picture matches other frames"
        return _kept(result, f"{share}; at least {FEWEST_MATCHED:.0%} is needed (texture)")
    known = world.information > _KNOWN
    zooms = priors.focal is not None and abs(world.zoom) > _MOST_ZOOM
    stands = known.mean() < FEWEST_MATCHED or world.parallax < _LEAST_PARALLAX
    if stands and _sweep(world) < _LEAST_TURN:
        world = world._replace(focal=1.0)  # nothing tells it
    by_cameras, made, change = _with_cameras(start, world), None, 0.0
    before = after = differences(result, step)
    if not zooms and not stands:
        measured = _measured(cells, world)
        if points is not None:
            measured = Measured(*map(np.concatenate, zip(measured, points, strict=True)))
        fields = fit_field(measured, frames, size, FieldPrior.of_error(world.error))
        fitted, change = _by_field(by_cameras, fields, step)
        after = differences(fitted, step)
        made = fitted if _agree(before, after, _MOST_WORSE) else None
    told = float(known.mean()) if made is not None else world.matched
    if made is None:  # cameras alone
        made, change, points = by_cameras, 0.0, None
        after = differences(made)
        if not _agree(before, after, _MOST_WORSE if stands else 1.0):  # pixels know best where a camera stands
            return _kept(result, "no depth was found by which the frames agree better")
    share = 0.0
    if join:
        made, share = _joined(made, tolerance_of(after), step)
        after = differences(made, step)
    tell(total, total)
    layers = (float(np.median(before)) if len(before) else None, float(np.median(after)))
    observations = 0 if points is None else len(points.frame)
    return _reported(made, ConsistencyReport(True, "", told, observations, change, *layers, share))


def _agree(before: Float32[np.ndarray, " N"], after: Float32[np.ndarray, " M"], most: float) -> bool:
    """Return whether the median difference of frames is at most so many times as large as before.

    Frames that saw nothing in common before, as their cameras were far off, agree if they do now.
    """
    if not len(before):
        return len(after) > 0
    return len(after) > 0 and bool(np.median(after) <= most * np.median(before))


def _measured(cells: Cells, world: DenseWorld) -> Measured:
    """Return the depths of cells over the result's, by the matches alone."""
    S, P = world.depth.shape
    row, column = np.divmod(np.arange(P), cells.grid[1])
    place = np.stack([(column + 0.5) / cells.grid[1], (row + 0.5) / cells.grid[0]], axis=1)
    information = world.information.astype(np.float64).ravel()
    measured = Measured(
        np.repeat(np.arange(S), P),
        np.tile(place, (S, 1)),
        np.log(world.depth / cells.depth).ravel().astype(np.float64),
        information / (1 + information / _BEST),
    )
    return measured.of(information > 0)


def _turned(result: Result, world: DenseWorld) -> float:
    """Return how far the adjustment turned the cameras of the frames, in degrees, on average."""
    before, after = (
        scipy.spatial.transform.Rotation.from_matrix(x[:, :, :3])
        for x in (result.camera_from_world, world.camera_from_world)
    )
    return float(np.degrees((after * before.inv()).magnitude().mean()))


def _sweep(world: DenseWorld) -> float:
    """Return the largest angle between the first camera and another, in degrees."""
    turns = scipy.spatial.transform.Rotation.from_matrix(world.camera_from_world[:, :, :3])
    return float(np.degrees((turns * turns[0].inv()).magnitude().max()))


def _with_cameras(result: AnyResult, world: DenseWorld) -> AnyResult:
    """Return the result with the world's cameras."""
    intrinsics, poses = zoomed(result.intrinsics, world.focal), world.camera_from_world.astype(np.float32)
    return dataclasses.replace(result, camera_from_world=poses, intrinsics=intrinsics)


def _by_field(result: AnyResult, fields: np.ndarray, step: Callable[[], None]) -> tuple[AnyResult, float]:
    """Return the result with depth times the fields' scales, and the mean |log| of these."""
    size, depth, change = result.depth.shape[1:], zeros_beside(result.depth, np.float32), []
    for frame, field in enumerate(fields):
        logs = at_pixels(field, (size[0], size[1]))
        depth[frame] = result.depth[frame] * np.exp(logs)
        change.append(np.abs(logs).mean())
        step()
    return dataclasses.replace(result, depth=depth), float(np.mean(change))


def _joined(result: AnyResult, tolerance: float, step: Callable[[], None]) -> tuple[AnyResult, float]:
    """Return the result with the mean depth of the frames that see a surface, and the share of static pixels joined."""
    depth, joined = zeros_beside(result.depth, np.float32), 0
    for frame in range(len(depth)):
        added, is_joined = join_frame(result, frame, tolerance)
        depth[frame] = result.depth[frame] * np.exp(added)
        joined += int(is_joined.sum())
        step()
    static = result.pictured - int(result.dynamic_mask.sum())
    return dataclasses.replace(result, depth=depth), joined / max(static, 1)


def _kept(result: AnyResult, reason: str, warns: bool = True) -> tuple[AnyResult, ConsistencyReport]:
    """Return the result as it is. Clips of one or two frames are kept without a warning: nothing else is expected."""
    report = ConsistencyReport(False, reason)
    logger.log(logging.WARNING if warns else logging.INFO, "%s", report.sentence)
    return _reported(result, report)


def _reported(result: AnyResult, report: ConsistencyReport) -> tuple[AnyResult, ConsistencyReport]:
    outcome = {"sentence": report.sentence, **dataclasses.asdict(report)}
    return dataclasses.replace(result, settings=result.settings | {"consistency": outcome}), report
