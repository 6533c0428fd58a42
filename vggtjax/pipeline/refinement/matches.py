"""Matches between the source's pictures: SIFT on pixels that do not move, verified pair by pair, by pycolmap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from PIL import Image

from vggtjax.pipeline.refinement.cells import check_number, check_size
from vggtjax.results.result import Result

WORKING_SIDE = 1600  # pixels; larger pictures are searched at this size
_MOST_FEATURES = 2048  # of a picture
_PEAK = 0.0025  # least contrast of a feature; COLMAP's 0.0067 finds few in dark or smooth scenes
_ERROR = 2.0  # working pixels; largest distance of a match from its epipolar line
_MOST_ANGLE, _RATIO = 0.7, 0.8  # radians; of the angle to the second nearest
_FEWEST = 15  # matches of a verified pair, as in COLMAP
_EXHAUSTIVE = 30  # frames, up to which every pair is matched
_WINDOW = 8  # frames; in longer clips each frame is matched with as many next ones, then at wider and wider steps
_GROWN = 64  # the masks grow by 1 / 64 of the frame's width

Pair = tuple[int, int]


class PictureFeatures(NamedTuple):
    """Features of a picture."""

    positions: Float64[np.ndarray, "N 2"]  # x, y in pixels of the source; edges at whole numbers
    descriptors: Float32[np.ndarray, "N 128"]  # RootSIFT, of length 1


def working_unit(result: Result) -> float:
    """Return pixels of the largest source picture per pixel at which features are searched, at least 1."""
    return max(1.0, float(result.source_size.max()) / WORKING_SIDE)


def frame_pairs(frames: int) -> list[Pair]:
    """Return the pairs to match: all of up to 30 frames, else those 1 to 8, 12, 16, 24, 32, 48, ... frames apart."""
    steps = range(1, frames)
    if frames > _EXHAUSTIVE:
        powers = [2**power for power in range(3, frames.bit_length())]
        steps = sorted({*range(1, _WINDOW + 1), *powers, *(step * 3 // 2 for step in powers)})
    return [(first, first + step) for step in steps for first in range(frames - step)]


def find_features(
    result: Result, pictures: Iterable[UInt8[np.ndarray, "h w 3"]], on_step: Callable[[], object]
) -> list[PictureFeatures]:
    """Return the features of each picture that lie on pixels which the model saw and which do not move.

    Raises ClipError for a missing picture, or one of another size than the result's.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = _MOST_FEATURES
    options.sift.peak_threshold = _PEAK
    extractor = pycolmap.FeatureExtractor.create(options, device=pycolmap.Device.cpu)
    static = _static_pixels(result)
    features: list[PictureFeatures] = []
    for frame, picture in enumerate(pictures):
        if frame == len(static):
            break
        check_size(result, frame, picture)
        height, width = picture.shape[:2]
        image = Image.fromarray(picture).convert("L")
        image.thumbnail((WORKING_SIDE, WORKING_SIDE))
        keypoints, descriptors = extractor.extract_from_uint8_array(np.asarray(image))
        found = np.array([(each.x, each.y) for each in keypoints], np.float64).reshape(-1, 2)
        positions = found * [width / image.width, height / image.height]
        kept = np.flatnonzero(_falls_on(static[frame], result, frame, positions) & _first_of_place(positions))
        described = descriptors.data.reshape(-1, 128)[kept].astype(np.float32)
        described /= np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1)
        features.append(PictureFeatures(positions[kept], described))
        on_step()
    check_number(result, len(features))
    return features


def match_pairs(
    features: Sequence[PictureFeatures], pairs: Sequence[Pair], unit: float, on_step: Callable[[], object]
) -> dict[Pair, Int64[np.ndarray, "K 2"]]:
    """Return the matches of the pairs that have at least 15 on one epipolar geometry, as indices of their features.

    The geometry is fitted without the focal lengths, which may be far off: a fundamental matrix or a homography.
    """
    import pycolmap

    verifying = pycolmap.TwoViewGeometryOptions()
    verifying.ransac.max_error = _ERROR * unit
    verifying.ransac.random_seed = 0
    verifying.detect_watermark = False
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=1, height=1, params=[1, 0, 0]
    )  # its focal length is no prior
    matches: dict[Pair, Int64[np.ndarray, "K 2"]] = {}
    for a, b in pairs:
        first, second = features[a], features[b]
        if min(len(first.positions), len(second.positions)) >= _FEWEST:
            found = mutual_matches(first.descriptors, second.descriptors)
            if len(found) >= _FEWEST:
                geometry = pycolmap.estimate_two_view_geometry(
                    camera, first.positions, camera, second.positions, found.astype(np.uint32), verifying
                )
                inliers = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
                if len(inliers) >= _FEWEST:
                    matches[a, b] = inliers
        on_step()
    return matches


def mutual_matches(
    first: Float32[np.ndarray, "N 128"], second: Float32[np.ndarray, "M 128"]
) -> Int64[np.ndarray, "K 2"]:
    """Return pairs of descriptors that are each other's nearest, and clearly nearer than the second nearest.

    By COLMAP's rules and thresholds (angles below 0.7 rad, and below 0.8 of the second), as one matrix product:
    pycolmap's own matcher takes eight times as long.
    """
    cosines = first @ second.T
    forth, back = _clear_nearest(cosines), _clear_nearest(cosines.T)
    mutual = np.flatnonzero((forth >= 0) & (back[forth] == np.arange(len(first))))
    return np.stack([mutual, forth[mutual]], axis=1)


def _clear_nearest(cosines: Float32[np.ndarray, "N M"]) -> Int64[np.ndarray, " N"]:
    """Return the nearest of each row, or -1 where it is too far or not clearly the nearest."""
    rows, nearest = np.arange(len(cosines)), cosines.argmax(axis=1)
    others = cosines.copy()
    others[rows, nearest] = -1
    best, second = (np.arccos(np.clip(each, -1, 1)) for each in (cosines[rows, nearest], others.max(axis=1)))
    return np.where((best <= _MOST_ANGLE) & (best < _RATIO * second), nearest, -1)


def _static_pixels(result: Result) -> Bool[np.ndarray, "S H W"]:
    """Return valid pixels that are static, and not next to moving ones."""
    grown = max(1, result.depth.shape[2] // _GROWN)
    moving = np.stack([scipy.ndimage.binary_dilation(mask, iterations=grown) for mask in result.dynamic_mask])
    return result.valid_pixels & np.logical_not(moving)


def _falls_on(
    pixels: Bool[np.ndarray, "H W"], result: Result, frame: int, positions: Float64[np.ndarray, "N 2"]
) -> Bool[np.ndarray, " N"]:
    """Return which positions in the source fall on one of these pixels of the frame."""
    height, width = pixels.shape
    column, row = np.floor((positions - result.source_offset[frame]) / result.source_scale[frame]).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside[inside] = pixels[row[inside], column[inside]]
    return inside


def _first_of_place(positions: Float64[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
    """Return which features are the first of their place: SIFT gives a place several orientations."""
    chosen = np.zeros(len(positions), bool)
    chosen[np.unique(positions.round(1), axis=0, return_index=True)[1]] = True
    return chosen
