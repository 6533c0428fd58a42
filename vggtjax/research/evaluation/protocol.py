"""One result against one sequence: all metrics that the ground truth allows, and the curves of their plots."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import isfinite
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import map_coordinates

from vggtjax.cameras import Similarity, checked_centres, umeyama_sim3
from vggtjax.errors import InputError
from vggtjax.research.evaluation.metrics.depth import Align, depth_alignment, video_depth_errors
from vggtjax.research.evaluation.metrics.masks import Empty, auc, frame_scores, mask_statistics
from vggtjax.research.evaluation.metrics.point_clouds import nearest_distances, paired_distance, statistics
from vggtjax.research.evaluation.metrics.trajectory import trajectory_errors
from vggtjax.research.evaluation.metrics.uncertainty import reliability_curve, sparsification_curve, uncertainty_scores
from vggtjax.research.evaluation.truth_at_pixels import AbsentError, TruthAtPixels, known_points
from vggtjax.results.frame import source_pixels
from vggtjax.results.result import Result, missing_fields

_HISTOGRAM = np.geomspace(1e-3, 10, 41)  # metres, bins of point distances
_UNKNOWN = np.float32(0)  # depth of pixels without a prediction; they are not scored
_PICTURED = 4  # frames whose maps are in the curves

_Outputs = tuple[dict[str, float], dict[str, np.ndarray]]  # metrics and curves


class Scores(NamedTuple):
    """The scores of a result on a sequence."""

    metrics: dict[str, float]
    notes: tuple[str, ...]  # a sentence for each protocol without truth or without prediction
    problems: tuple[str, ...]  # a sentence for each protocol that failed
    curves: dict[str, np.ndarray]  # for the plots


def score(result: Result, truth: TruthAtPixels, *, depth_align: Align = "scale", empty: Empty = "davis") -> Scores:
    """Score a result by each protocol of docs/reference/evaluation-protocols.md that the sequence has ground truth for.

    Args:
        result: of the sequence's frames, in their order.
        truth: of the sequence, at the pixels of this result.
        depth_align: alignment of video depth to the truth.
        empty: J of a frame in which neither mask has a pixel: 1 ("davis") or 0 ("vggt4d").

    Returns:
        The metrics, all finite; notes and problems say why others are missing.
    """
    metrics: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    notes: list[str] = []
    problems: list[str] = []
    protocols: dict[str, Callable[[Result, TruthAtPixels], _Outputs]] = {
        "trajectory": _trajectory,
        "point clouds": _point_clouds,
        "masks": partial(_masks, empty=empty),
        "video depth": partial(_video_depth, align=depth_align),
        "uncertainty": _uncertainty,
    }
    for name, protocol in protocols.items():
        try:
            values, drawn = protocol(result, truth)
        except AbsentError as reason:
            notes.append(f"{name}: {reason}")
        except InputError as error:
            problems.append(f"{name}: {error}")
        else:
            problems += [
                f"{name}: {key} is {value}, not finite" for key, value in values.items() if not isfinite(value)
            ]
            metrics |= {key: float(value) for key, value in values.items() if isfinite(value)}
            curves |= drawn
    return Scores(metrics, tuple(notes), tuple(problems), curves)


def _check_predicted(result: Result, field: str, what: str) -> None:
    """Raise AbsentError for a field with constants in place of a prediction."""
    if field in missing_fields(result):
        raise AbsentError(f"the result has no {what}")


def _check_any(known: np.ndarray) -> None:
    """Raise AbsentError where no pixel has a true depth and a predicted one."""
    if not known.any():
        raise AbsentError("no pixel with a true depth has a predicted one")


def _trajectory(result: Result, truth: TruthAtPixels) -> _Outputs:
    poses = truth.poses
    errors = trajectory_errors(result.world_from_camera[truth.posed], poses)
    similarity = _alignment(result, truth, allow_line=True)
    found = similarity.apply(result.camera_centres[truth.posed])
    return errors._asdict(), {"centres": found, "true_centres": poses[:, :3, 3]}


def _alignment(result: Result, truth: TruthAtPixels, *, allow_line: bool = False) -> Similarity:
    found = checked_centres(result.camera_from_world[truth.posed])
    return umeyama_sim3(found, truth.poses[:, :3, 3], allow_line=allow_line)


def _point_clouds(result: Result, truth: TruthAtPixels) -> _Outputs:
    true, known = truth.points, truth.shown
    is_predicted = result.depth[known] != _UNKNOWN
    known &= result.depth != _UNKNOWN
    _check_any(is_predicted)
    intrinsics = result.intrinsics.astype(np.float64)
    predicted = known_points(result.depth, intrinsics, result.camera_from_world.astype(np.float64), known)
    if not np.isfinite(predicted).all():
        raise InputError(f"{int((~np.isfinite(predicted).all(axis=1)).sum())} predicted points are not finite")
    similarity = _alignment(result, truth)
    predicted = similarity.apply(predicted).astype(np.float32)
    paired = paired_distance(predicted, true[is_predicted])
    ways = {"accuracy": (predicted, true), "completeness": (true, predicted)}
    metrics: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {"distance_bins": _HISTOGRAM}
    for name, (points, others) in ways.items():
        distances = nearest_distances(points, others)
        metrics |= {f"{name}_{kind}": value for kind, value in statistics(distances)._asdict().items()}
        curves[name] = np.histogram(np.clip(distances, *_HISTOGRAM[[0, -1]]), _HISTOGRAM)[0]
    metrics |= {f"distance_paired_{kind}": value for kind, value in paired._asdict().items()}
    for kind in ("mean", "median"):
        metrics[f"distance_chamfer_{kind}"] = (metrics[f"accuracy_{kind}"] + metrics[f"completeness_{kind}"]) / 2
    return metrics, curves


def _masks(result: Result, truth: TruthAtPixels, *, empty: Empty) -> _Outputs:
    _check_predicted(result, "dynamic_mask", "masks")
    used = truth.masked
    true = truth.mask[used]
    inside = result.inside_pictures[used]
    predicted = result.dynamic_mask[used] & inside
    rows, columns = (np.flatnonzero(inside.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    window = np.s_[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]  # without padding
    frames = frame_scores(predicted[window], true[window], empty=empty)
    metrics = dict(mask_statistics(frames)._asdict())
    metrics |= {} if used.all() else {"mask_frames": float(used.sum())}
    of_patches = result.saliency if result.motion is None else result.motion  # what the mask was cut from
    if of_patches is not None and true.any() and not true[inside].all():
        factors = (1, *(big // small for big, small in zip(true.shape[1:], of_patches.shape[1:], strict=True)))
        saliency = np.kron(of_patches[used], np.ones(factors, np.float32))
        metrics["saliency_auc"] = auc(saliency[inside], true[inside])
    some = _pictured(len(true))
    shown = np.flatnonzero(used)[some]
    pictures = {"masks": predicted[some], "true_masks": true[some]}
    return metrics, {"j": frames.j, "f": frames.f, "images": result.images[shown], "shown": shown, **pictures}


def _video_depth(result: Result, truth: TruthAtPixels, *, align: Align) -> _Outputs:
    true = truth.depth_at_source
    predicted, in_frame = depth_at_source(result)
    true = np.where(in_frame, true, 0)
    if not (true > 0).any():
        raise AbsentError("no pixel of the sequence has a true depth")
    true = np.where(predicted != _UNKNOWN, true, 0)
    _check_any(true > 0)
    errors = video_depth_errors(predicted, true, align)
    scale, shift = depth_alignment(predicted[true > 0], true[true > 0], align)
    metrics = {f"depth_{key}" if key == "pixels" else key: value for key, value in errors._asdict().items()}
    return metrics, _depth_maps(result, truth, scale, shift)


def _depth_maps(result: Result, truth: TruthAtPixels, scale: float, shift: float) -> dict[str, np.ndarray]:
    """Return for some frames, at the result's pixels, the aligned depth, the true depth and the relative error."""
    shown = _pictured(len(result.depth))
    true = truth.depth[shown]
    maps = (scale * result.depth[shown].astype(np.float64) + shift).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.where((true > 0) & (result.depth[shown] != _UNKNOWN), np.abs(maps - true) / true, np.nan)
    return {
        "error_maps": errors.clip(max=100).astype(np.float16),
        "true_depth": true,
        "depth": maps,
        "images": result.images[shown],
        "shown": shown,
    }


def depth_at_source(result: Result) -> tuple[Float32[np.ndarray, "S h w"], Bool[np.ndarray, "S h w"]]:
    """Return the depth at the source's size, bilinear as in the protocols of video depth, and the pixels in the frame.

    Without a crop, that is a resize with half-pixel centres; a crop is undone first. Depth 0 is unknown and is never
    blended: a pixel whose nearest one is unknown is 0, and others are blended from those that are known.

    Raises:
        InputError: frames of different sizes.
    """
    sizes = {(int(height), int(width)) for height, width in result.source_size}
    if len(sizes) > 1:
        raise InputError(f"the pictures have {len(sizes)} sizes; video depth needs one size")
    (height, width) = sizes.pop()
    depth = np.zeros((len(result.depth), height, width), np.float32)
    in_frame = np.zeros(depth.shape, bool)
    for frame, (left, top, right, bottom) in enumerate(result.valid_box):
        x, y, in_frame[frame] = source_pixels(result, frame)
        places = np.stack(np.meshgrid(y - top - 0.5, x - left - 0.5, indexing="ij"))
        depth[frame] = _blended(result.depth[frame, top:bottom, left:right], places)
    return depth, in_frame


def _blended(depth: Float32[np.ndarray, "H W"], places: Float64[np.ndarray, "2 h w"]) -> Float32[np.ndarray, "h w"]:
    """Return depth at places (y, x), bilinear over what is known; 0 where the nearest pixel is unknown."""
    known = depth != _UNKNOWN
    values = map_coordinates(depth, places, order=1, mode="nearest")
    if known.all():
        return values
    share = map_coordinates(known.astype(np.float32), places, order=1, mode="nearest")
    nearest = map_coordinates(known.astype(np.uint8), places, order=0, mode="nearest") > 0
    return np.where(nearest, values / np.where(nearest & (share > 0), share, 1), _UNKNOWN)


def _uncertainty(result: Result, truth: TruthAtPixels) -> _Outputs:
    known = (truth.depth > 0) & (result.depth != _UNKNOWN)
    _check_predicted(result, "depth_confidence", "confidence")
    _check_any(known)
    predicted, true = result.depth[known].astype(np.float64), truth.depth[known].astype(np.float64)
    precision = result.depth_confidence[known].astype(np.float64)
    true /= depth_alignment(predicted, true, "scale")[0]  # the precision is in the unit of the prediction
    if np.array_equal(predicted, true):
        raise AbsentError("all errors are 0; a confidence cannot be scored")
    scores = uncertainty_scores(predicted, true, precision)
    sparsification = sparsification_curve(np.abs(predicted - true), precision)
    levels, shares = reliability_curve(predicted - true, precision, 1.0)
    calibrated = reliability_curve(predicted - true, precision, scores.scale)[1]
    curves = {"sparsification": np.stack(sparsification), "reliability": np.stack([levels, shares, calibrated])}
    return {f"uncertainty_{key}" if key == "scale" else key: value for key, value in scores._asdict().items()}, curves


def _pictured(frames: int) -> np.ndarray:
    return np.unique(np.linspace(0, frames - 1, min(frames, _PICTURED)).round().astype(int))
