"""One result against one sequence: every metric that its ground truth allows, and the curves behind them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from math import isfinite
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.ndimage import map_coordinates

from vggtjax import cameras as geometry
from vggtjax.clips.truth import Placed, at_clip_pixels, intrinsics_at_clip_pixels
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.sequence import LabelledSequence
from vggtjax.evaluation.metrics.masks import Empty, auc, frame_scores, mask_scores
from vggtjax.evaluation.metrics.point_clouds import nearest_distances, paired_distance, statistics
from vggtjax.evaluation.metrics.trajectory import (
    FEWEST_POSES,
    Similarity,
    centres,
    moves,
    trajectory_errors,
    umeyama_sim3,
)
from vggtjax.evaluation.metrics.uncertainty import reliability_curve, sparsification_curve, uncertainty_scores
from vggtjax.evaluation.metrics.video_depth import Align, depth_alignment, video_depth_errors
from vggtjax.results.reconstruction import Reconstruction

PIXEL_OFFSET = 0.0  # of points: the protocol lifts whole pixel numbers, predicted and true ones alike
_HISTOGRAM = np.geomspace(1e-3, 10, 41)  # metres, bins of point distances
_SHOWN = 4  # frames whose maps are kept for pictures
_AT_ONCE = 1 << 20  # points that are moved at a time

Progress = Callable[[int, int], object]
_Found = tuple[dict[str, float], dict[str, np.ndarray]]


class Scores(NamedTuple):
    """What a result scores on a sequence."""

    metrics: dict[str, float]
    notes: tuple[str, ...]  # what there is no truth, or no prediction, for: a sentence each
    problems: tuple[str, ...]  # what should have been scored and could not be
    curves: dict[str, np.ndarray]  # what plots are drawn from


class _AbsentError(InputError):
    """What a protocol compares is not part of the sequence or of the result: no failure, and no number."""


class TruthAtPixels:
    """A sequence's ground truth at the pixels of results that are placed alike; read once, when asked for.

    Depth beyond `max_depth` metres counts as unknown.
    """

    def __init__(self, sequence: LabelledSequence, placed: Placed, *, max_depth: float | None = None) -> None:
        self.sequence = sequence
        self.max_depth = max_depth
        self._placed = placed

    def fits(self, placed: Placed) -> bool:
        """Return whether another result lies at the very same places."""
        names = ("source_size", "source_scale", "source_offset", "valid_box")
        same = (np.array_equal(getattr(self._placed, name), getattr(placed, name)) for name in names)
        return self._placed.images.shape == placed.images.shape and all(same)

    @cached_property
    def depth_at_source(self) -> Float32[np.ndarray, "S h w"]:
        """Metres, 0 where unknown, at the size of the pictures."""
        if (read := self.sequence.depth) is None:
            raise _AbsentError("the sequence has no depth")
        depth = _stacked("depth", [read(i).astype(np.float32) for i in range(len(self.sequence))])
        if self.max_depth is not None:
            depth[depth >= self.max_depth] = 0
        return depth

    @cached_property
    def depth(self) -> Float32[np.ndarray, "S H W"]:
        """The same at the pixels of the result: every one takes the depth in which its centre lies."""
        depth = at_clip_pixels(self._placed, self.depth_at_source)
        if not (depth > 0).any():
            raise _AbsentError("no pixel of the sequence has a true depth")
        return depth

    @cached_property
    def mask(self) -> Bool[np.ndarray, "S H W"]:
        """What moves, at the pixels of the result."""
        if (read := self.sequence.mask) is None:
            raise _AbsentError("the sequence has no masks")
        return at_clip_pixels(self._placed, _stacked("masks", [read(i) for i in range(len(self.sequence))]))

    @property
    def poses(self) -> Float64[np.ndarray, "S 4 4"]:
        """Cameras, world from camera."""
        poses = self.sequence.world_from_camera
        if poses is None:
            raise _AbsentError("the sequence has no camera poses")
        if len(poses) < FEWEST_POSES or not moves(poses[:, :3, 3]):
            raise _AbsentError(f"the {len(poses)} true cameras do not move; there is nothing to align by")
        return poses

    @cached_property
    def points(self) -> Float32[np.ndarray, "N 3"]:
        """Points in the true world, of all pixels with a true depth."""
        if self.sequence.intrinsics is None:
            raise _AbsentError("the sequence has no intrinsics")
        intrinsics = intrinsics_at_clip_pixels(self._placed, self.sequence.intrinsics)
        return known_points(self.depth, intrinsics, _inverse(self.poses), self.depth > 0)


def _stacked(what: str, maps: list[np.ndarray]) -> np.ndarray:
    sizes = {one.shape for one in maps}
    if len(sizes) > 1:
        raise InputError(f"{what} of the sequence have {len(sizes)} sizes, {sorted(sizes)[:3]}; expected one for all")
    return np.stack(maps)


def known_points(
    depth: Float[np.ndarray, "S H W"],
    intrinsics: Float[np.ndarray, "S 3 3"],
    camera_from_world: Float[np.ndarray, "S 3 4"],
    known: Bool[np.ndarray, "S H W"],
) -> Float32[np.ndarray, "N 3"]:
    """Lift the pixels that are known to their points, frame by frame: no more than one frame is in float64."""
    points = np.empty((int(known.sum()), 3), np.float32)
    end = 0
    for one in range(len(depth)):
        here = slice(one, one + 1)
        lifted = geometry.unproject(
            depth[here].astype(np.float64), intrinsics[here], camera_from_world[here], pixel_offset=PIXEL_OFFSET
        )
        start, end = end, end + int(known[one].sum())
        points[start:end] = lifted[0][known[one]]
    return points


def score(
    result: Reconstruction,
    truth: TruthAtPixels,
    *,
    depth_align: Align = "scale",
    empty: Empty = "davis",
    progress: Progress | None = None,
) -> Scores:
    """Score a result by every protocol that the sequence has ground truth for (docs/evaluation.md states them).

    Args:
        result: of the sequence's frames, in their order.
        truth: of the sequence, at the pixels of this result.
        depth_align: how video depth is brought to the truth's unit.
        empty: J of a frame in which neither mask has a pixel: 1 ("davis") or 0 ("vggt4d").
        progress: called while point clouds are compared.

    Returns:
        The metrics that could be computed; notes and problems say why others could not.
    """
    metrics: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    notes: list[str] = []
    problems: list[str] = []
    protocols: dict[str, Callable[[Reconstruction, TruthAtPixels], _Found]] = {
        "trajectory": _trajectory,
        "point clouds": partial(_point_clouds, progress=progress),
        "masks": partial(_masks, empty=empty),
        "video depth": partial(_video_depth, align=depth_align),
        "uncertainty": _uncertainty,
    }
    for name, protocol in protocols.items():
        try:
            found, drawn = protocol(result, truth)
        except _AbsentError as reason:
            notes.append(f"{name}: {reason}")
        except InputError as error:
            problems.append(f"{name}: {error}")
        else:
            problems += [f"{name}: {key} is {value}, not finite" for key, value in found.items() if not isfinite(value)]
            metrics |= {key: float(value) for key, value in found.items() if isfinite(value)}
            curves |= drawn
    return Scores(metrics, tuple(notes), tuple(problems), curves)


def _predicted(result: Reconstruction, field: str, what: str) -> None:
    """Raise _AbsentError if a field of a result was never predicted, and plain values stand for it."""
    if field in result.settings.get("missing", ()):
        raise _AbsentError(f"the result has no {what}")


def _trajectory(result: Reconstruction, truth: TruthAtPixels) -> _Found:
    poses = truth.poses
    errors = trajectory_errors(result.world_from_camera, poses)
    similarity = _alignment(result, poses, allow_line=True)
    curves = {
        "centres": similarity.apply(result.camera_centres),
        "true_centres": poses[:, :3, 3],
    }
    return {"ate": errors.ate, "rte": errors.rte, "rre": errors.rre}, curves


def _alignment(result: Reconstruction, poses: Float64[np.ndarray, "S 4 4"], *, allow_line: bool = False) -> Similarity:
    return umeyama_sim3(centres(result.camera_from_world), poses[:, :3, 3], allow_line=allow_line)


def _point_clouds(result: Reconstruction, truth: TruthAtPixels, *, progress: Progress | None) -> _Found:
    true, known = truth.points, truth.depth > 0
    intrinsics = result.intrinsics.astype(np.float64)
    predicted = known_points(result.depth, intrinsics, result.camera_from_world.astype(np.float64), known)
    if not np.isfinite(predicted).all():
        raise InputError(f"{int((~np.isfinite(predicted).all(axis=1)).sum())} predicted points are not finite")
    similarity = _alignment(result, truth.poses)
    for start in range(0, len(predicted), _AT_ONCE):
        predicted[start : start + _AT_ONCE] = similarity.apply(predicted[start : start + _AT_ONCE])
    paired = paired_distance(predicted, true)
    ways = {"accuracy": (predicted, true), "completeness": (true, predicted)}
    metrics: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {"distance_bins": _HISTOGRAM}
    for part, (name, (points, others)) in enumerate(ways.items()):
        distances = nearest_distances(points, others, progress=_half(progress, part))
        metrics |= {f"{name}_{kind}": value for kind, value in statistics(distances)._asdict().items()}
        curves[name] = np.histogram(np.clip(distances, *_HISTOGRAM[[0, -1]]), _HISTOGRAM)[0]
    metrics |= {f"distance_paired_{kind}": value for kind, value in paired._asdict().items()}
    for kind in ("mean", "median"):
        metrics[f"distance_chamfer_{kind}"] = (metrics[f"accuracy_{kind}"] + metrics[f"completeness_{kind}"]) / 2
    return metrics, curves


def _half(progress: Progress | None, part: int) -> Progress | None:
    return None if progress is None else lambda done, total: progress(done + part * total, 2 * total)


def _masks(result: Reconstruction, truth: TruthAtPixels, *, empty: Empty) -> _Found:
    true = truth.mask
    _predicted(result, "dynamic_mask", "masks")
    inside = result.inside_pictures
    predicted = result.dynamic_mask & inside
    rows, columns = (np.flatnonzero(inside.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    window = np.s_[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]  # padding is no part of the picture
    metrics = dict(mask_scores(predicted[window], true[window], empty=empty)._asdict())
    if result.saliency is not None and true.any() and not true[inside].all():
        factors = (1, *(big // small for big, small in zip(true.shape[1:], result.saliency.shape[1:], strict=True)))
        saliency = np.kron(result.saliency, np.ones(factors, np.float32))
        metrics["saliency_auc"] = auc(saliency[inside], true[inside])
    region, boundary = frame_scores(predicted[window], true[window], empty=empty)
    shown = _shown(len(true))
    pictures = {"masks": predicted[shown], "true_masks": true[shown]}
    return metrics, {"j": region, "f": boundary, "images": result.images[shown], "shown": shown, **pictures}


def _video_depth(result: Reconstruction, truth: TruthAtPixels, *, align: Align) -> _Found:
    true = truth.depth_at_source
    predicted, seen = depth_at_source(result)
    true = np.where(seen, true, 0)
    if not (true > 0).any():
        raise _AbsentError("no pixel of the sequence has a true depth")
    errors = video_depth_errors(predicted, true, align)
    scale, shift = depth_alignment(predicted[true > 0], true[true > 0], align)
    metrics = {f"depth_{key}" if key == "pixels" else key: value for key, value in errors._asdict().items()}
    return metrics, _depth_maps(result, truth, scale, shift)


def _depth_maps(result: Reconstruction, truth: TruthAtPixels, scale: float, shift: float) -> dict[str, np.ndarray]:
    """Return aligned depth of some frames at the result's pixels, the true one, and the relative error."""
    shown = _shown(len(result.depth))
    true = truth.depth[shown]
    maps = (scale * result.depth[shown].astype(np.float64) + shift).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.where(true > 0, np.abs(maps - true) / true, np.nan)
    return {
        "error_maps": errors.clip(max=100).astype(np.float16),
        "true_depth": true,
        "depth": maps,
        "images": result.images[shown],
        "shown": shown,
    }


def depth_at_source(
    result: Reconstruction,
) -> tuple[Float32[np.ndarray, "S h w"], Bool[np.ndarray, "S h w"]]:
    """Return the depth resized bilinearly to the source's size, as the protocols of video depth do, and what was seen.

    Where nothing was cut off, that is a resize with half-pixel centres; else the crop is undone first.

    Raises:
        InputError: frames of different sizes.
    """
    sizes = {(int(height), int(width)) for height, width in result.source_size}
    if len(sizes) > 1:
        raise InputError(f"the pictures have {len(sizes)} sizes; expected one for video depth")
    (height, width) = sizes.pop()
    depth = np.zeros((len(result.depth), height, width), np.float32)
    seen = np.zeros(depth.shape, bool)
    for frame, (left, top, right, bottom) in enumerate(result.valid_box):
        scale, offset = result.source_scale[frame], result.source_offset[frame]
        x = (np.arange(width) + 0.5 - offset[0]) / scale[0]
        y = (np.arange(height) + 0.5 - offset[1]) / scale[1]
        places = np.stack(np.meshgrid(y - top - 0.5, x - left - 0.5, indexing="ij"))
        inside = result.depth[frame, top:bottom, left:right]
        depth[frame] = map_coordinates(inside, places, order=1, mode="nearest")
        seen[frame] = ((y >= top) & (y <= bottom))[:, None] & ((x >= left) & (x <= right))[None]
    return depth, seen


def _uncertainty(result: Reconstruction, truth: TruthAtPixels) -> _Found:
    known = truth.depth > 0
    _predicted(result, "depth_confidence", "confidence")
    predicted, true = result.depth[known].astype(np.float64), truth.depth[known].astype(np.float64)
    precision = result.depth_confidence[known].astype(np.float64)
    true /= depth_alignment(predicted, true, "scale")[0]  # in the unit of the prediction, which the precision is of
    if np.array_equal(predicted, true):
        raise _AbsentError("all errors are 0; there is nothing that a confidence could be about")
    scores = uncertainty_scores(predicted, true, precision)
    removed, kept, oracle = sparsification_curve(np.abs(predicted - true), precision)
    levels, shares = reliability_curve(predicted - true, precision, 1.0)
    calibrated = reliability_curve(predicted - true, precision, scores.scale)[1]
    curves = {
        "sparsification": np.stack([removed, kept, oracle]),
        "reliability": np.stack([levels, shares, calibrated]),
    }
    return {f"uncertainty_{key}" if key == "scale" else key: value for key, value in scores._asdict().items()}, curves


def _shown(frames: int) -> np.ndarray:
    return np.unique(np.linspace(0, frames - 1, min(frames, _SHOWN)).round().astype(int))


def _inverse(world_from_camera: Float64[np.ndarray, "S 4 4"]) -> Float64[np.ndarray, "S 3 4"]:
    return geometry.world_from_camera(world_from_camera[:, :3])[:, :3]
