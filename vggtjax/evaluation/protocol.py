"""One result against one sequence: every metric that its ground truth allows, and the curves behind them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import map_coordinates

from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.sequence import Sequence
from vggtjax.evaluation.masks import auc, frame_scores, mask_scores
from vggtjax.evaluation.point_clouds import nearest_distances, paired_distance, statistics
from vggtjax.evaluation.trajectory import Similarity, centres, trajectory_errors, umeyama_sim3
from vggtjax.evaluation.truth import Placed, at_clip_pixels, intrinsics_at_clip_pixels
from vggtjax.evaluation.uncertainty import reliability_curve, sparsification_curve, uncertainty_scores
from vggtjax.evaluation.video_depth import Align, depth_alignment, video_depth_errors
from vggtjax.results import geometry
from vggtjax.results.reconstruction import Reconstruction

PIXEL_OFFSET = 0.0  # of points: the protocol lifts whole pixel numbers, predicted and true ones alike
_HISTOGRAM = np.geomspace(1e-3, 10, 41)  # metres, bins of point distances
_SHOWN = 4  # frames whose maps are kept for pictures

Progress = Callable[[int, int], object]
_Found = tuple[dict[str, float], dict[str, np.ndarray]]


class Scores(NamedTuple):
    """What a result scores on a sequence."""

    metrics: dict[str, float]
    notes: tuple[str, ...]  # why some metric is not there, a sentence each
    curves: dict[str, np.ndarray]  # what plots are drawn from


class TruthAtPixels:
    """A sequence's ground truth at the pixels of results that are placed alike; read once, when asked for."""

    def __init__(self, sequence: Sequence, placed: Placed) -> None:
        self.sequence = sequence
        self._placed = placed

    @cached_property
    def depth_at_source(self) -> Float32[np.ndarray, "S h w"] | None:
        """Metres, 0 where unknown, at the size of the pictures."""
        read = self.sequence.depth
        return None if read is None else np.stack([read(i).astype(np.float32) for i in range(len(self.sequence))])

    @cached_property
    def depth(self) -> Float32[np.ndarray, "S H W"] | None:
        """The same at the pixels of the result: every one takes the depth in which its centre lies."""
        return None if self.depth_at_source is None else at_clip_pixels(self._placed, self.depth_at_source)

    @cached_property
    def mask(self) -> Bool[np.ndarray, "S H W"] | None:
        """What moves, at the pixels of the result."""
        read = self.sequence.mask
        masks = None if read is None else np.stack([read(i) for i in range(len(self.sequence))])
        return None if masks is None else at_clip_pixels(self._placed, masks)

    @cached_property
    def points(self) -> Float32[np.ndarray, "S H W 3"] | None:
        """Points in the true world; those of unknown depth are at the camera's centre."""
        sequence = self.sequence
        if self.depth is None or sequence.world_from_camera is None or sequence.intrinsics is None:
            return None
        intrinsics = intrinsics_at_clip_pixels(self._placed, sequence.intrinsics)
        return geometry.unproject(
            self.depth, intrinsics, _inverse(sequence.world_from_camera), pixel_offset=PIXEL_OFFSET
        )


def score(
    result: Reconstruction,
    truth: TruthAtPixels,
    *,
    depth_align: Align = "scale",
    max_depth: float | None = None,
    progress: Progress | None = None,
) -> Scores:
    """Score a result by every protocol that the sequence has ground truth for (docs/evaluation.md states them).

    Args:
        result: of the sequence's frames, in their order.
        truth: of the sequence, at the pixels of this result.
        depth_align: how video depth is brought to the truth's unit.
        max_depth: metres beyond which true depth does not count for video depth; None for all.
        progress: called while point clouds are compared.

    Returns:
        The metrics that could be computed; notes say why others could not.
    """
    metrics: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    notes: list[str] = []
    protocols: dict[str, Callable[[Reconstruction, TruthAtPixels], _Found]] = {
        "trajectory": _trajectory,
        "point clouds": partial(_point_clouds, progress=progress),
        "masks": _masks,
        "video depth": partial(_video_depth, align=depth_align, max_depth=max_depth),
        "uncertainty": _uncertainty,
    }
    for name, protocol in protocols.items():
        try:
            found, drawn = protocol(result, truth)
        except InputError as error:
            notes.append(f"{name}: {error}")
            continue
        metrics |= {key: float(value) for key, value in found.items()}
        curves |= drawn
    return Scores(metrics, tuple(notes), curves)


def _missing(what: str) -> InputError:
    return InputError(f"the sequence has no {what}")


def _trajectory(result: Reconstruction, truth: TruthAtPixels) -> _Found:
    poses = truth.sequence.world_from_camera
    if poses is None:
        raise _missing("camera poses")
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
    poses = truth.sequence.world_from_camera
    if poses is None or truth.points is None or truth.depth is None:
        raise _missing("depth with cameras")
    known = truth.depth > 0
    if not known.any():
        raise InputError("no pixel of the sequence has a true depth")
    predicted = result.world_points(pixel_offset=PIXEL_OFFSET)[known]
    if not np.isfinite(predicted).all():
        raise InputError(f"{int((~np.isfinite(predicted).all(axis=1)).sum())} predicted points are not finite")
    predicted = _alignment(result, poses).apply(predicted).astype(np.float32)
    true = truth.points[known]
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


def _masks(result: Reconstruction, truth: TruthAtPixels) -> _Found:
    if truth.mask is None:
        raise _missing("masks")
    scores = mask_scores(result.dynamic_mask, truth.mask)
    metrics = dict(scores._asdict())
    if result.saliency is not None and truth.mask.any() and not truth.mask.all():
        factors = (
            1,
            *(big // small for big, small in zip(truth.mask.shape[1:], result.saliency.shape[1:], strict=True)),
        )
        metrics["saliency_auc"] = auc(np.kron(result.saliency, np.ones(factors, np.float32)), truth.mask)
    region, boundary = frame_scores(result.dynamic_mask, truth.mask)
    shown = _shown(len(truth.mask))
    pictures = {"masks": result.dynamic_mask[shown], "true_masks": truth.mask[shown]}
    return metrics, {"j": region, "f": boundary, "images": result.images[shown], "shown": shown, **pictures}


def _video_depth(result: Reconstruction, truth: TruthAtPixels, *, align: Align, max_depth: float | None) -> _Found:
    true = truth.depth_at_source
    if true is None:
        raise _missing("depth")
    predicted, seen = depth_at_source(result)
    errors = video_depth_errors(predicted, np.where(seen, true, 0), align, max_depth=max_depth)
    metrics = {f"depth_{key}" if key == "pixels" else key: value for key, value in errors._asdict().items()}
    return metrics, _depth_maps(result, truth)


def _depth_maps(result: Reconstruction, truth: TruthAtPixels) -> dict[str, np.ndarray]:
    """Return aligned depth of some frames at the result's pixels, the true one, and the relative error."""
    _, _, scale = _known_depth(result, truth)
    shown = _shown(len(result.depth))
    true_maps = _present(truth.depth)[shown]
    maps = (scale * result.depth[shown].astype(np.float64)).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.where(true_maps > 0, np.abs(maps - true_maps) / true_maps, np.nan)
    return {
        "error_maps": errors.clip(max=100).astype(np.float16),
        "true_depth": true_maps,
        "depth": maps,
        "images": result.images[shown],
        "shown": shown,
    }


def _known_depth(
    result: Reconstruction, truth: TruthAtPixels
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"], float]:
    """Return predicted and true depth where the truth is known, and the scale that takes one to the other."""
    known = _present(truth.depth) > 0
    if not known.any():
        raise InputError("no pixel of the sequence has a true depth")
    predicted, true = result.depth[known].astype(np.float64), _present(truth.depth)[known].astype(np.float64)
    return predicted, true, depth_alignment(predicted, true, "scale")[0]


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
    predicted, true, scale = _known_depth(result, truth)
    precision = result.depth_confidence[_present(truth.depth) > 0].astype(np.float64)
    true /= scale  # in the unit of the prediction, which the precision is of
    scores = uncertainty_scores(predicted, true, precision)
    removed, kept, oracle = sparsification_curve(np.abs(predicted - true), precision)
    levels, shares = reliability_curve(predicted - true, precision, 1.0)
    calibrated = reliability_curve(predicted - true, precision, scores.scale)[1]
    curves = {
        "sparsification": np.stack([removed, kept, oracle]),
        "reliability": np.stack([levels, shares, calibrated]),
    }
    return {f"uncertainty_{key}" if key == "scale" else key: value for key, value in scores._asdict().items()}, curves


def _present(depth: np.ndarray | None) -> np.ndarray:
    if depth is None:
        raise _missing("depth")
    return depth


def _shown(frames: int) -> np.ndarray:
    return np.unique(np.linspace(0, frames - 1, min(frames, _SHOWN)).round().astype(int))


def _inverse(world_from_camera: Float64[np.ndarray, "S 4 4"]) -> Float64[np.ndarray, "S 3 4"]:
    return geometry.world_from_camera(world_from_camera[:, :3])[:, :3]
